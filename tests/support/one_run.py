"""What the processes of one run of the tests (``pytest -n``) share: things that one of them begins, and turns."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pytest


def folder_of(factory: pytest.TempPathFactory) -> Path:
    """A folder that all processes of this run have."""
    own = factory.getbasetemp()
    return own.parent if "PYTEST_XDIST_WORKER" in os.environ else own


@contextmanager
def begun_once(folder: Path, name: str, begin: Callable[[], str], end: Callable[[], None]) -> Iterator[str]:
    """What ``begin`` has told, whichever process it was that called it; who is the last to leave calls ``end``."""
    with (folder / f"{name}.users").open("a+") as users:
        with _locked(folder / f"{name}.door"):
            fcntl.flock(users, fcntl.LOCK_SH)
            users.seek(0)
            told = users.read()
            if not told:
                told = begin()
                users.write(told)
                users.flush()
        try:
            yield told
        finally:
            with _locked(folder / f"{name}.door"):
                try:
                    fcntl.flock(users, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    pass  # others have it still
                else:
                    users.truncate(0)
                    end()


@contextmanager
def turn(folder: Path, name: str, *, alone: bool) -> Iterator[None]:
    """Beside others of this run, or ``alone``, as soon as there are no others."""
    with (folder / f"{name}.turn").open("a") as turns:
        fcntl.flock(turns, fcntl.LOCK_EX if alone else fcntl.LOCK_SH)
        yield


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    with path.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
