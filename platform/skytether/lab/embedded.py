"""An orchestrator of one's own, as a child process, for demonstrations, replays and benchmarks."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

_START_TIMEOUT = 60.0
_STOP_TIMEOUT = 10.0


class EmbeddedError(Exception):
    """The orchestrator did not come up; the text is its own last line."""


class EmbeddedOrchestrator:
    """Runs ``skytether orchestrator run`` on loopback and ends it, with all it started, on exit.

    It is a real child process, not a thread: what works here works with an orchestrator elsewhere, and it
    can be killed and started again over the same state (``kill``, ``start``). It ends, with its instances, also when
    this process is killed; only a temporary state directory is left then.
    """

    def __init__(self, state_dir: Path | None = None, environment: Mapping[str, str] | None = None) -> None:
        """Without a state directory a temporary one is used, and removed at the end.

        ``environment`` is added to this process's.
        """
        self._environment = {**os.environ, **(environment or {})}
        self._temporary = None if state_dir else tempfile.TemporaryDirectory(prefix="skytether-")
        self.state_dir = state_dir or Path(self._temporary.name if self._temporary else "")
        self._process: subprocess.Popen[bytes] | None = None
        self._port = 0

    @property
    def url(self) -> str:
        """Base address; the same over restarts."""
        return f"http://127.0.0.1:{self._port}"

    @property
    def operator_token(self) -> str:
        """The token made at the first start."""
        return (self.state_dir / "operator.token").read_text().strip()

    @property
    def pid(self) -> int:
        """Of its process, while it runs."""
        if self._process is None:
            raise EmbeddedError("the orchestrator does not run")
        return self._process.pid

    @property
    def log(self) -> str:
        """What the orchestrator wrote so far."""
        return (self.state_dir / "orchestrator.log").read_text(errors="replace")

    def start(self) -> subprocess.Popen[bytes]:
        """Start, and return its process once it answers.

        Raises:
            EmbeddedError: It ended or did not answer in time.
        """
        address = self.state_dir / "address"
        address.unlink(missing_ok=True)
        command = [sys.executable, "-P", "-m", "skytether.lab.tethered", "orchestrator", "run", "--stop-instances"]
        command += ["--state-dir", str(self.state_dir), "--port", str(self._port)]
        self._let_go()
        with (self.state_dir / "orchestrator.log").open("ab") as log:
            process = self._process = subprocess.Popen(
                command,
                env=self._environment,
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        try:
            self._port = self._wait_for(address, process)
        except BaseException:
            self.kill()
            raise
        return process

    def _wait_for(self, address: Path, process: subprocess.Popen[bytes]) -> int:
        """The port, once the file that tells it is there."""
        deadline = time.monotonic() + _START_TIMEOUT
        while not address.exists():
            if process.poll() is not None:
                lines = self.log.strip().splitlines()
                raise EmbeddedError(f"the orchestrator did not start: {lines[-1] if lines else 'no output'}")
            if time.monotonic() > deadline:
                raise EmbeddedError(f"the orchestrator did not answer within {_START_TIMEOUT:.0f} s")
            time.sleep(0.01)
        return int(address.read_text().strip().rsplit(":", 1)[1])

    def stop(self) -> None:
        """End it and every instance that it started, also those that outlived a crash of it."""
        if not self._port:
            return
        process = self._process
        if process is None or process.poll() is not None:
            process = self.start()  # to adopt and end what still runs
        process.terminate()
        try:
            process.wait(_STOP_TIMEOUT)
        except subprocess.TimeoutExpired:
            self.kill()
        self._let_go()
        self._port = 0

    def kill(self) -> None:
        """Kill the orchestrator alone, as a crash would; its instances go on."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._let_go()

    def _let_go(self) -> None:
        """Forget a process that ended."""
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()
        self._process = None

    def __enter__(self) -> EmbeddedOrchestrator:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
        if self._temporary is not None:
            self._temporary.cleanup()
