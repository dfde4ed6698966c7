"""Users without a name, one for each instance of a process site where the orchestrator is root."""

from __future__ import annotations

import json
import logging
import subprocess
import sys

from . import confine

log = logging.getLogger(__name__)

USERS = (61_184, 65_519)
"""Their numbers, as systemd takes them for its dynamic users (systemd.exec(5))."""
_TRIES = 3
_END_S = 30


def noted_user(noted: object) -> int | None:
    """One of them, from a note; None: it names none."""
    return noted if type(noted) is int and USERS[0] <= noted <= USERS[1] else None


def end_all_of(user: int) -> None:
    """Kill all that runs as one of them, in one call of the kernel: whoever forks all the time escapes a list."""
    if noted_user(user) is None:
        raise ValueError(f"{user} is no instance's own user")
    command = [sys.executable, "-I", "-S", confine.__file__, json.dumps({"end": user})]
    said = ""
    for _ in range(_TRIES):  # another orchestrator may be at the same user, and end ours with it
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=_END_S, check=False)
        except (OSError, subprocess.SubprocessError) as error:
            said = str(error)
            continue
        if done.returncode == 0:
            return
        said = done.stderr.strip()
    log.warning("what runs as user %d may not have ended: %s", user, said)
