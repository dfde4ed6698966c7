"""A program of its own that becomes a gate which is told to end when the agent has died.

``python -m skytether.cli.commands.robot.own_gate AGENT ROBOT.YAML ...``.
The kernel sends SIGTERM when the parent is gone. That outlives `exec`, so it is set here, where there is one thread,
and the gate's own program need not know of it.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def main(agent: int, *arguments: str) -> None:
    """Set it and become the gate; end if the agent is gone already."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() == agent:
        command = [sys.executable, "-P", "-m", "skytether.cli", "robot", "gate", *arguments]
        os.execv(sys.executable, command)  # noqa: S606 - a list of arguments


if __name__ == "__main__":
    main(int(sys.argv[1]), *sys.argv[2:])
