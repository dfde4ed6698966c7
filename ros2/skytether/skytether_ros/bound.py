"""Becomes another program that is told to end when the node that started it has died.

``python bound.py NODE PROGRAM ...``. The kernel sends SIGTERM when the parent is gone, and that outlives `exec`. It is
set here, in a process with one thread: a node with a middleware has several.
"""

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def main(node, *command):
    """Set it and become the program; end if the node is gone already."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() == node:
        os.execv(command[0], command)  # noqa: S606 - a list of arguments


if __name__ == "__main__":
    main(int(sys.argv[1]), *sys.argv[2:])
