"""The health check of a container, and what keeps it content."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from pathlib import Path

from skytether.service import health
from skytether.service.beat import beating, touch


def grant(folder: Path, **more: object) -> str:
    path = folder / "grant.json"
    path.write_text(json.dumps({"ready_file": str(folder / "ready.json"), "session_key": "secret", **more}))
    return str(path)


def test_a_service_is_alive_while_its_ready_file_is_touched(tmp_path: Path) -> None:
    path = grant(tmp_path)
    ready = tmp_path / "ready.json"
    ready.write_text("{}")
    os.utime(ready, (1000.0, 1000.0))
    assert health.check(path, 1000.0 + health.SILENT_S) == ""
    assert health.check(path, 1001.0 + health.SILENT_S) == "the service's loop has hung for 11 s"


def test_before_it_is_ready_it_is_not_well(tmp_path: Path) -> None:
    assert health.check(str(tmp_path / "grant.json"), 0.0) == "the service is not ready: FileNotFoundError"
    assert health.check(grant(tmp_path), 0.0) == "the service is not ready: FileNotFoundError"
    (tmp_path / "grant.json").write_text("secret")
    assert health.check(str(tmp_path / "grant.json"), 0.0) == "the service is not ready: JSONDecodeError"


def test_a_step_that_hangs_ends_the_touches(tmp_path: Path) -> None:
    ready = tmp_path / "ready.json"
    ready.write_text("{}")
    os.utime(ready, (1000.0, 1000.0))
    assert not touch(str(ready), health.SILENT_S)
    assert ready.stat().st_mtime == 1000.0
    assert touch(str(ready), 0.5)
    assert ready.stat().st_mtime > 1000.0
    assert touch(str(tmp_path / "gone"), 0.0)


def test_the_file_is_touched_again_and_again_until_the_end(tmp_path: Path) -> None:
    asked = threading.Semaphore(0)

    def in_step_for() -> float:
        asked.release()
        return 0.0

    ready = tmp_path / "ready.json"
    ready.write_text("{}")
    with beating(str(ready), in_step_for, period=0.001):
        assert asked.acquire(timeout=30)
        assert asked.acquire(timeout=30)
    with beating(None, in_step_for):
        pass
    assert not [thread for thread in threading.enumerate() if thread.name == "beat"]


def test_the_check_is_a_small_program(tmp_path: Path) -> None:
    ready = tmp_path / "ready.json"
    command = [sys.executable, "-ISE", str(health.__file__)]
    environment = {"SKYTETHER_GRANT": grant(tmp_path)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (1, "the service is not ready: FileNotFoundError\n")
    ready.write_text("{}")
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "alive\n")
