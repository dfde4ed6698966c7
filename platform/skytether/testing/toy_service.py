"""The smallest thing that a runtime can run: ``python -m skytether.testing.toy_service``.

It takes a UDP port, says that it is ready, and waits to be ended; its parameters (:class:`Behaviour`) make it fail in a
chosen way. It speaks no protocol and imports the standard library only (but in a pod), so it is up in some tens of
milliseconds.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_BEAT_S = 1.0
"""Between two touches of its ready file, as services show that they do not hang: their health check looks for that."""
_CHILD = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up'); time.sleep(600)"


@dataclass(frozen=True)
class Behaviour:
    """What it does; times in seconds."""

    say: str = "toy service"
    """Its first line of log."""
    exit_status: int | None = None
    """Ends at once with this, before it is ready."""
    ignore_sigterm: bool = False
    never_ready: bool = False
    child: bool = False
    """Starts a process of its own that ignores SIGTERM, and says ``child PID``."""
    environment: bool = False
    """Says the names of all its environment variables."""
    flood: int = 0
    """Says this many lines."""
    report: str = ""
    """Reports this, with the code ``said``, before it is ready."""
    hog_mb: int = 0
    """Takes this much memory before it is ready."""


def main() -> int:
    """Run until SIGTERM; returns the exit status."""
    grant = json.loads(Path(os.environ["SKYTETHER_GRANT"]).read_text())
    wanted = Behaviour(**grant["params"])
    print(wanted.say)  # noqa: T201 (a service's log is its standard output)
    if wanted.exit_status is not None:
        return wanted.exit_status
    # Taken by `sigtimedwait` below: to set an event in a handler hangs where the event is just being waited for.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
    if wanted.environment:
        print("environment " + " ".join(sorted(os.environ)))  # noqa: T201
    if wanted.child:
        child = subprocess.Popen([sys.executable, "-uc", _CHILD], stdout=subprocess.PIPE)
        if child.stdout:
            child.stdout.readline()
        print(f"child {child.pid}")  # noqa: T201
    hoard = b"x" * (wanted.hog_mb << 20)
    for number in range(wanted.flood):
        print(f"line {number}")  # noqa: T201
    with ExitStack() as stack, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        bound.bind((grant["bind_host"], grant["bind_port"]))
        ready = Path(grant["ready_file"])
        if grant.get("health_port"):
            stack.enter_context(_answering(grant))
        if wanted.report:
            told = {"reports": [{"number": 1, "code": "said", "message": wanted.report}]}
            ready.with_name("reports.json").write_text(json.dumps(told))
        if not wanted.never_ready:
            draft = ready.with_suffix(".new")
            draft.write_text(json.dumps({"port": bound.getsockname()[1], "pid": os.getpid()}))
            draft.replace(ready)
        while signal.sigtimedwait({signal.SIGTERM}, _BEAT_S) is None or wanted.ignore_sigterm:
            with suppress(OSError):  # its folder may be gone
                os.utime(ready)
    del hoard
    return 0


def _answering(grant: dict[str, Any]) -> AbstractContextManager[None]:
    """As services do in a pod."""
    from skytether.api.grant import Grant
    from skytether.service.health_port import answering

    return answering(Grant.model_validate(grant))


if __name__ == "__main__":
    sys.exit(main())
