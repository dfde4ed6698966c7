"""Watches over the programs of a service's ROS graph: ``python -m skytether.service.ros_guard FOLDER``, a child of it.

Nodes that roslaunch starts lead sessions of their own, so they would outlive a service that is killed. The guard is
their ancestor whoever else dies (PR_SET_CHILD_SUBREAPER). It starts what it is told to, one JSON line each on standard
input, tells what ended on standard output, and when its input closes, for whatever reason, it ends every process below
it and removes the folder.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

import psutil

CORE = "roscore"
"""Name of the program that the others need."""
_PR_SET_CHILD_SUBREAPER = 36
_POLL_S = 0.1
_PATIENCE_S = 8.0
"""From the interrupt, by which roslaunch ends its nodes in order, to the kill."""


class RosGuard:
    """The service's side: starts the guard, gives it programs, hears of their ends.

    Args:
        folder: Removed at the end.
        environment: Of the programs.
    """

    def __init__(self, folder: Path, environment: Mapping[str, str]) -> None:
        self._environment = dict(environment)
        # A session of its own: whoever ends the service's does not end the guard, which then does its work.
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "skytether.service.ros_guard", str(folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            text=True,
        )

    def run(self, name: str, *command: str) -> None:
        """Have a program started."""
        line = json.dumps({"name": name, "command": command, "environment": self._environment})
        if self._process.stdin is not None:
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()

    def ended(self) -> str:
        """One sentence if a program has ended; empty while all run. Returns at once."""
        output = self._process.stdout
        if output is None or not select.select([output], [], [], 0)[0]:
            return ""
        line = output.readline()
        if not line:
            return "the guard of the ROS programs was ended"
        told = json.loads(line)
        return f"{told['name']} ended with status {told['status']}"

    def close(self) -> None:
        """Have everything ended, and wait for it."""
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
        try:
            self._process.wait(3 * _PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()


def guard(folder: Path) -> None:
    """Be the guard, until the input closes."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    programs: dict[str, subprocess.Popen[bytes]] = {}
    waiting = b""
    while True:
        if select.select([sys.stdin], [], [], _POLL_S)[0]:
            data = os.read(sys.stdin.fileno(), 65_536)
            if not data:
                break
            *lines, waiting = (waiting + data).split(b"\n")
            for line in lines:
                told = json.loads(line)
                programs[told["name"]] = _start(told["command"], told["environment"])
        for name in [name for name, program in programs.items() if program.poll() is not None]:
            with contextlib.suppress(OSError):  # nobody hears it any more
                print(json.dumps({"name": name, "status": programs.pop(name).returncode}), flush=True)  # noqa: T201
        _reap(programs)
    _end_all([program for name, program in programs.items() if name != CORE])
    shutil.rmtree(folder, ignore_errors=True)


def _start(command: list[str], environment: dict[str, str]) -> subprocess.Popen[bytes]:
    def undo_ignoring() -> None:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)

    return subprocess.Popen(
        command,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=sys.stderr,
        start_new_session=True,
        preexec_fn=undo_ignoring,
    )


def _reap(programs: Mapping[str, subprocess.Popen[bytes]]) -> None:
    """Orphans of programs come to the guard; those that ended are let go."""
    ours = {program.pid for program in programs.values()}
    for child in psutil.Process().children():
        if child.pid not in ours:
            with contextlib.suppress(ChildProcessError, psutil.Error):
                os.waitpid(child.pid, os.WNOHANG)


def _end_all(programs: Iterable[subprocess.Popen[bytes]]) -> None:
    """Interrupt what has nodes, for them to end in order; then kill what is left, the core too: it keeps nothing."""
    deadline = time.monotonic() + _PATIENCE_S
    for program in programs:
        with contextlib.suppress(ProcessLookupError):
            program.send_signal(signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            program.wait(max(0.1, deadline - time.monotonic()))
    while (left := psutil.Process().children(recursive=True)) and time.monotonic() < deadline + _PATIENCE_S:
        for process in left:
            with contextlib.suppress(psutil.Error):
                process.kill()
        psutil.wait_procs(left, timeout=1.0)


if __name__ == "__main__":
    guard(Path(sys.argv[1]))
