"""Users without a name, one for each instance of a process site where the orchestrator is root."""

from __future__ import annotations

import json
import logging
import os
import pwd
import random
import stat
import subprocess
import sys
import threading
from itertools import chain

from . import confine
from .base import RuntimeFailure
from .procfs import users_of_processes

log = logging.getLogger(__name__)

USERS = (61_184, 65_519)
"""Their numbers, as systemd takes them for its dynamic users (systemd.exec(5))."""
_taken: dict[str, int] = {}
"""By instance, of all sites of this program: who ends one user's processes must end nobody else's."""
_lock = threading.Lock()
_TRIES = 3
_END_S = 30


def noted_user(noted: object) -> int | None:
    """One of them, from a note; None: it names none."""
    return noted if type(noted) is int and USERS[0] <= noted <= USERS[1] else None


def allocate_user(instance: str, noted: int | None) -> int:
    """An instance's own, until it is given back: the same again, that of its runs before, or one that nobody is.

    Raises:
        RuntimeFailure: There are no more.
    """
    with _lock:
        if instance in _taken:
            return _taken[instance]
        busy = users_of_processes().union(_taken.values())
        first, most = random.SystemRandom().randint(*USERS), USERS[1] + 1
        for number in chain([] if noted is None else [noted], range(first, most), range(USERS[0], first)):
            if number not in busy and not _has_name(number):
                _taken[instance] = number
                return number
    raise RuntimeFailure(f"all users from {USERS[0]} to {USERS[1]} are taken")


def keep_user(instance: str, noted: int | None) -> int | None:
    """Of a run that an earlier orchestrator began; None: it had none of its own, or another instance has it now."""
    with _lock:
        if noted is None or any(number == noted and other != instance for other, number in _taken.items()):
            return None
        _taken[instance] = noted
        return noted


def free_user(instance: str) -> None:
    """Nothing of the instance is left."""
    with _lock:
        _taken.pop(instance, None)


def _has_name(user: int) -> bool:
    try:
        pwd.getpwuid(user)
    except KeyError:
        return False
    return True


def hand_over(folder: str, user: int) -> None:
    """Give a user a folder and all in it, the folder itself last: until then it is nobody's but its owner's.

    What was in it came from a service. So no link is followed, and no file is given away that has another name, which
    may be anywhere.

    Raises:
        OSError: It cannot be done.
    """
    try:
        for _, _, names, at in os.fwalk(folder, topdown=False, onerror=_raised, follow_symlinks=False):
            for name in names:
                found = os.stat(name, dir_fd=at, follow_symlinks=False)
                if stat.S_ISREG(found.st_mode) and found.st_nlink == 1:
                    os.chown(name, user, user, dir_fd=at, follow_symlinks=False)
            os.fchown(at, user, user)
    except RecursionError:
        raise OSError(f"folders in {folder} are nested too deeply") from None


def _raised(error: OSError) -> None:
    raise error


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
