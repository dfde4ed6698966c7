"""The entry point of ``skytether``. Nothing is imported before signals are taken care of."""

from __future__ import annotations

import signal
import sys

INTERRUPTED = 128 + signal.SIGINT
"""Exit status of a command that was told to end, as shells have it."""


def main() -> None:
    """Run the command line. A request to end is an interrupt, so that what was started is ended in order."""
    try:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup
            signal.signal(signal.SIGHUP, signal.default_int_handler)
        from .app import app

        app()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
