"""A log file that is followed, and one over HTTP."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest

from skytether.api import client
from skytether.api.rest import InstanceCreate
from skytether.orchestrator.runtimes.base import LogStream
from skytether.orchestrator.runtimes.file_log import FileLog
from skytether.testing.runtimes import FakeRuntime


def test_the_last_lines_then_what_is_new_then_the_end(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_text("one\ntwo\nthree\n")
    ended = threading.Event()
    log = FileLog(path, 2, ended.is_set, poll=0.001)
    assert log.read() == "two\nthree\n"
    with path.open("a") as file:
        file.write("four\n")
    assert log.read() == "four\n"
    ended.set()
    with path.open("a") as file:
        file.write("five\n")
    assert log.read() == "five\n"  # what was written until the end is read
    assert log.read() is None


@pytest.mark.slow
def test_a_silent_log_says_so_and_a_closed_one_ends(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_text("")
    log = FileLog(path, 2, lambda: False, poll=0.001)
    assert log.read() == ""
    log.close()
    log.close()
    assert log.read() is None


class Script(LogStream):
    def __init__(self, pieces: list[str]) -> None:
        self.pieces = pieces
        self.closed = False

    def read(self) -> str | None:
        return self.pieces.pop(0) if self.pieces else None

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Script:
    made = Script(["one\n", "", "two\n"])
    monkeypatch.setattr(FakeRuntime, "follow", lambda *_: made)
    return made


def test_it_goes_over_http_until_the_run_ends(served: Any, script: Script, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "END_SEEN_S", 0.2)
    runtime = served.site()
    robot = served.robot()
    made = robot.create_instance(InstanceCreate(robot="walker", service="toy"))
    robot.wait_running(made.id)
    text = ""
    for piece in robot.follow_logs(made.id):
        text += piece
        if text.endswith("two\n"):
            runtime.crash(made.id)
    assert text == "one\ntwo\n"
    assert script.closed
