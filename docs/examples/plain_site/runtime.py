"""Each instance is a plain process with a folder of its own: for one orchestrator, on its own machine.

Nothing holds the services: they may do all that the orchestrator's user may. The runtime `process` does it better; this
one is here to be read.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from shutil import rmtree
from typing import Any

import psutil

from skytether.api.grant import GRANT_VARIABLE
from skytether.api.manifest import ServiceSpec, Strict
from skytether.api.service_report import FILE_NAME, pull_reports
from skytether.orchestrator.runtimes.base import Capacity, Launch, Observation, Phase, Runtime, RuntimeFailure

KILL_S = 5.0
"""Seconds that the kernel gets to end a killed process."""


class PlainOptions(Strict):
    """Options of such a site."""

    cpu: float = 4.0
    memory_mb: int = 4096


class PlainRuntime(Runtime):
    """Runs ``python -m ENTRYPOINT``."""

    Options = PlainOptions

    def __init__(self, site: str, folder: Path, options: Strict) -> None:
        """Whatever runs there already is found by the files in ``folder``."""
        if not isinstance(options, PlainOptions):
            raise TypeError("options must be PlainOptions")
        self._folder, self._options = folder, options
        self._statuses: dict[int, int | None] = {}
        """Of our own children that have ended, by pid."""
        self._asked: set[int] = set()
        """Who was asked to end: once only, for a service may take a second signal for impatience."""

    def refuses(self, spec: ServiceSpec) -> str | None:
        return None if spec.entrypoint else "the service has no entrypoint"

    def capacity(self) -> Capacity:
        return Capacity(self._options.cpu, self._options.memory_mb)

    def start(self, launch: Launch) -> None:
        folder = self._folder / launch.instance
        old = read(folder / "run.json")
        if old.get("attempt") == launch.attempt:
            return
        self._end(old)
        ready = folder / "ready.json"
        port = read(ready).get("port", 0)  # robots know the earlier run's
        ready.unlink(missing_ok=True)
        (folder / FILE_NAME).unlink(missing_ok=True)
        (folder / "data").mkdir(mode=0o700, parents=True, exist_ok=True)
        grant = launch.grant.model_copy(
            update={"bind_port": port, "ready_file": str(ready), "data_dir": str(folder / "data")}
        )
        write(folder / "grant.json", grant.model_dump_json())
        try:
            pid = spawn(["-m", str(launch.spec.entrypoint)], folder)
            began = psutil.Process(pid).create_time()
        except (OSError, psutil.Error) as error:
            raise RuntimeFailure(f"cannot start {launch.grant.service} on this machine: {error}") from error
        self._asked.discard(pid)  # pids come again
        self._statuses.pop(pid, None)
        write(folder / "run.json", json.dumps({"attempt": launch.attempt, "pid": pid, "began": began}))

    def observe(self) -> Mapping[str, Observation]:
        runs = {path.parent.name: read(path) for path in self._folder.glob("*/run.json")}
        return {instance: self._observe(instance, run) for instance, run in runs.items()}

    def _observe(self, instance: str, run: dict[str, Any]) -> Observation:
        folder, attempt = self._folder / instance, run["attempt"]
        reports = pull_reports(read(folder / FILE_NAME))
        if self._process(run) is None:
            status = self._statuses.get(run["pid"])
            line = self.logs(instance, 1).rstrip("\n")
            return Observation(attempt, Phase.EXITED, exit_status=status, last_line=line, reports=reports)
        port = read(folder / "ready.json").get("port")
        if port is None:
            return Observation(attempt, Phase.STARTING)
        return Observation(attempt, Phase.RUNNING, "127.0.0.1", port, reports=reports)

    def stop(self, instance: str, *, force: bool) -> None:
        run = read(self._folder / instance / "run.json")
        if force:
            self._end(run)
        elif (process := self._process(run)) and process.pid not in self._asked:
            self._asked.add(process.pid)
            with suppress(psutil.NoSuchProcess):
                process.terminate()

    def remove(self, instance: str) -> None:
        self._end(read(self._folder / instance / "run.json"))
        rmtree(self._folder / instance, ignore_errors=True)

    def logs(self, instance: str, lines: int) -> str:
        try:
            text = (self._folder / instance / "log").read_text(errors="replace")
        except FileNotFoundError:
            return ""
        return "".join(text.splitlines(keepends=True)[-lines:])

    def _process(self, run: dict[str, Any]) -> psutil.Process | None:
        """The one that was started, never another one that got its pid; None: it has ended."""
        if run.get("pid", 0) in {0, *self._statuses}:
            return None
        with suppress(ChildProcessError):  # an earlier orchestrator's child
            pid, status = os.waitpid(run["pid"], os.WNOHANG)
            if pid:
                self._statuses[pid] = os.waitstatus_to_exitcode(status)
                return None
        with suppress(psutil.Error):
            process = psutil.Process(run["pid"])
            if process.create_time() == run["began"] and process.status() != psutil.STATUS_ZOMBIE:
                return process
        return None

    def _end(self, run: dict[str, Any]) -> None:
        if process := self._process(run):
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # with all that it started
            with suppress(psutil.Error):
                self._statuses[process.pid] = process.wait(KILL_S)


def spawn(arguments: list[str], folder: Path) -> int:
    """Start Python in a session of its own, which the orchestrator's end leaves alone."""
    kept = {name: os.environ[name] for name in ("PATH", "LANG") if name in os.environ}  # the others may hold secrets
    environment = {**kept, "PYTHONUNBUFFERED": "1", GRANT_VARIABLE: str(folder / "grant.json")}
    log = (os.POSIX_SPAWN_OPEN, 1, str(folder / "log"), os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    files = [log, (os.POSIX_SPAWN_DUP2, 1, 2)]
    return os.posix_spawn(
        sys.executable, [sys.executable, "-P", *arguments], environment, file_actions=files, setsid=True
    )


def read(path: Path) -> dict[str, Any]:
    """A JSON object; empty where there is none, or a service wrote something else."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def write(path: Path, text: str) -> None:
    """At once and for ourselves only: a grant holds the session's key."""
    new = path.with_suffix(".new")
    with open(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
        file.write(text)
    new.replace(path)
