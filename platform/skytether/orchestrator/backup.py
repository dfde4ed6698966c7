"""A copy of what an orchestrator cannot make anew: database, keys, operator's token; taken while it runs.

What a copy does not hold are instances' folders (recordings belong to their owners) and, with PostgreSQL, the database,
which has tools of its own (``pg_dump``).
"""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path

from .domain.security import KEY, OLD_KEY, OPERATOR
from .nodes.authority import KEY as NODES_KEY

DATABASE = "state.db"
SECRETS = (KEY, OPERATOR)
_MAYBE = (NODES_KEY,)
"""Of machines that joined, where any may."""


class BackupError(Exception):
    """It cannot be done; one sentence saying what to do."""


def backup(state_dir: Path, to: Path) -> list[str]:
    """Copy into a new folder that only its owner can enter; the names of what was copied.

    Raises:
        BackupError: There is nothing to copy, or no room for it; nothing incomplete is left.
    """
    if not (state_dir / SECRETS[0]).exists():
        raise BackupError(f"{state_dir} is no state folder of an orchestrator: give it with --state-dir")
    try:
        to.mkdir(mode=0o700, parents=True)
    except FileExistsError:
        raise BackupError(f"{to} is there already: give a folder that is not") from None
    except OSError as error:
        raise BackupError(f"cannot make {to}: {error.strerror}") from error
    copied = []
    try:
        if (state_dir / DATABASE).exists():
            os.close(os.open(to / DATABASE, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))  # whatever the umask says
            with (
                closing(sqlite3.connect(state_dir / DATABASE)) as source,
                closing(sqlite3.connect(to / DATABASE)) as copy,
            ):
                source.backup(copy)  # consistent, whatever is written meanwhile
                copy.execute("PRAGMA journal_mode=DELETE")  # one file
            copied.append(DATABASE)
        for name in (*SECRETS, *_there(state_dir, _MAYBE), *_old_keys(state_dir)):
            _copy(state_dir / name, to / name)
            copied.append(name)
    except (OSError, sqlite3.Error) as error:
        shutil.rmtree(to, ignore_errors=True)
        raise BackupError(f"the copy failed, nothing of it is left: {error}") from error
    return copied


def restore(source: Path, state_dir: Path) -> list[str]:
    """Put a copy into a state folder that holds none; the names of what was put there.

    Raises:
        BackupError: It is no copy, or there is a state already.
    """
    if not (source / SECRETS[0]).exists():
        raise BackupError(f"{source} is no backup of an orchestrator")
    present = [name for name in (DATABASE, *SECRETS) if (state_dir / name).exists()]
    if present:
        raise BackupError(f"{state_dir} holds {', '.join(present)}: move that away first, or give another --state-dir")
    try:
        state_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
        put = [*_there(source, (DATABASE, *SECRETS, *_MAYBE)), *_old_keys(source)]
        for name in put:
            _copy(source / name, state_dir / name)
    except OSError as error:
        raise BackupError(f"cannot write {state_dir}: {error.strerror}") from error
    return put


def _there(folder: Path, names: Iterable[str]) -> list[str]:
    return [name for name in names if (folder / name).exists()]


def _old_keys(folder: Path) -> list[str]:
    """Of sessions from before a rotation, the oldest first: so they stay by time."""
    return [path.name for path in sorted(folder.glob(f"{OLD_KEY}*"), key=lambda path: path.stat().st_mtime_ns)]


def _copy(source: Path, to: Path) -> None:
    with source.open("rb") as read, open(os.open(to, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as write:
        shutil.copyfileobj(read, write)
        write.flush()
        os.fsync(write.fileno())
