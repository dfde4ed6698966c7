"""Runs ``skytether ARGUMENTS`` for as long as somebody holds the other end of its standard input.

``kill -9`` lets no program clean up behind itself; that its pipe breaks nobody can keep from the one at the other end.
"""

from __future__ import annotations

import os
import runpy
import signal
import threading


def _watch() -> None:
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    threading.Thread(target=_watch, name="tether", daemon=True).start()
    runpy.run_module("skytether.cli", run_name="__main__", alter_sys=True)
