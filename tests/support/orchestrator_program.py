"""The orchestrator as a program, for tests that start and kill it."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from skytether.api.client import Client
from skytether.orchestrator.runtimes.procfs import ProcessStat

PATIENCE = 60.0
"""Seconds; a start takes three of processor time, a busy machine gives them slowly."""


class Program:
    """``skytether orchestrator run`` over one state folder."""

    def __init__(self, folder: Path, *options: str) -> None:
        self.folder = folder
        self.options = options
        self.code: Path | None = None
        """Another source root than this one's."""
        self.environment: dict[str, str] = {}
        """More variables."""
        self.process: subprocess.Popen[bytes] | None = None

    @property
    def log(self) -> str:
        return (self.folder.parent / "log").read_text()

    def spawn(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "skytether.cli", "orchestrator", "run", "--state-dir", str(self.folder)]
        given = {**os.environ, **self.environment}
        path = os.pathsep.join([*([str(self.code)] if self.code else []), given.get("PYTHONPATH", "")])
        with (self.folder.parent / "log").open("ab") as log:
            self.process = subprocess.Popen(
                [*command, "--port", "0", *self.options],
                stdout=log,
                stderr=log,
                env={**given, "PYTHONPATH": path, "PYTHONFAULTHANDLER": "1"},
            )
        return self.process

    def start(self) -> Client:
        (self.folder / "address").unlink(missing_ok=True)
        self.spawn()
        until(lambda: (self.folder / "address").exists(), self)
        return self.client((self.folder / "operator.token").read_text().strip())

    def client(self, token: str) -> Client:
        """A patient one: it is not told of a slow machine that nobody answers."""
        return Client((self.folder / "address").read_text().strip(), token, timeout=PATIENCE)

    def last_words(self) -> str:
        """End one that did not do what it should; its log, with what each of its threads was at."""
        assert self.process is not None
        with contextlib.suppress(ProcessLookupError):
            self.process.send_signal(signal.SIGABRT)
        status = self.process.wait(PATIENCE)
        return f"{self.log}\nstatus {status}"

    def end(self, number: int = signal.SIGTERM) -> int:
        assert self.process is not None
        self.process.send_signal(number)
        status = self.process.wait(PATIENCE)
        self.process = None
        return status

    def fails(self) -> tuple[int, str]:
        """Start one that cannot; its status and its only line."""
        status = self.spawn().wait(PATIENCE)
        self.process = None
        lines = self.log.strip().splitlines()
        assert len(lines) == 1, self.log
        return status, lines[0]

    def pid_of(self, instance: str) -> int:
        note = self.folder / "sites/local/instances" / instance / "run.json"
        return int(json.loads(note.read_text())["process"][0])

    def clean_up(self) -> None:
        begun: set[int] = set()
        if self.process is not None and self.process.poll() is None:
            self.process.send_signal(signal.SIGSTOP)
            # One that was forked and does not run its program yet cannot be told by its environment.
            begun = {child.pid for child in psutil.Process(self.process.pid).children()}
            self.process.kill()
            self.process.wait()
        for pid in begun | self.services():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def services(self) -> set[int]:
        """All processes that have a grant in this state folder."""
        mine = b"SKYTETHER_GRANT=" + os.fsencode(self.folder)
        return {int(p.name) for p in Path("/proc").glob("[0-9]*") if mine in environment(p)}


def environment(process: Path) -> bytes:
    with contextlib.suppress(OSError):
        return (process / "environ").read_bytes()
    return b""


def until(condition: Callable[[], Any], program: Program | None = None, patience: float = PATIENCE) -> float:
    """Wait for it; returns how long it took."""
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < patience, program.log if program else ""
        assert program is None or program.process is None or program.process.poll() is None, program.log
        time.sleep(0.005)
    return time.monotonic() - began


def alive(pid: int) -> bool:
    stat = ProcessStat.read(pid)
    return stat is not None and not stat.zombie


def with_toy(client: Client, manifest: Any) -> Client:
    client.put_service("toy", manifest(needs={"cpu": 0.01, "memory_mb": 1}, params={"additionalProperties": True}))
    return client
