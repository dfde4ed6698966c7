"""``python -m skytether.guard FD``: what `skytether robot gate` becomes when the configuration is checked."""

from __future__ import annotations

import gc
import os
import signal
import sys

from . import privileges
from .log import Log
from .loop import Guard, GuardError
from .settings import load, thaw


def main() -> None:
    """Guard the wheels."""
    refused = privileges.acquire(privileges.GUARD)
    log = Log("guard")
    try:
        file = int(sys.argv[1])
        settings = load(thaw(file))
        os.close(file)
    except (IndexError, ValueError, TypeError, KeyError, OSError) as error:
        log.line("ERROR", f"is started by `skytether robot gate robot.yaml`, which hands over what it needs ({error})")
        log.close()
        sys.exit(2)
    ended: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:  # nohup
            signal.signal(number, lambda got, _: ended.append(got))
    try:
        guard = Guard(settings, log, refused)
    except GuardError as error:
        log.line("ERROR", str(error))
        log.close()
        sys.exit(1)
    for sentence in settings.say:
        log.line("INFO", sentence)
    gc.collect()
    gc.freeze()
    told = guard.run(lambda: bool(ended))
    log.close()
    os._exit(0 if told else 1)  # no thread that hangs at a disk or a pipe holds up the end


if __name__ == "__main__":
    main()
