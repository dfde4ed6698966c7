"""Files in containers, as far as an orchestrator is told of them."""

from __future__ import annotations

import asyncio
import io
import os
import stat
import tarfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from http import HTTPStatus
from pathlib import PurePosixPath
from typing import Any, TypeVar

from skytether.api.service_report import MOST_BYTES

from .archives import STAT, is_odd, moved, pull_stat, push_stat, ways
from .asking import JSON, TAR, Asking, RefusedCall
from .engine_rules import FOLDER
from .images import Images

_T = TypeVar("_T")
_KNOWN = 4096
"""Containers that are remembered."""
_TODO = "add CapabilityBoundingSet=CAP_DAC_READ_SEARCH to the node's unit (systemctl edit skytether-node)"


class Files:
    """Of one engine's containers. What is answered: status, content, and a row for the head.

    Args:
        engine: Path of its socket.
        asking: Asks it.
    """

    def __init__(self, engine: str, asking: Asking) -> None:
        self._asking = asking
        self._images = Images(engine)
        self._opened: set[str] = set()
        """Containers into whose files the engine may look."""

    async def may_be_opened(self, container: str) -> None:
        """Raises `RefusedCall` unless the engine may look into its files, or it is gone."""
        if container in self._opened:
            return
        status, found = await self._asking.asked(f"/containers/{container}/json")
        if status == HTTPStatus.NOT_FOUND:
            return
        if status != HTTPStatus.OK or (refused := moved(found)):
            raise RefusedCall(f"its files are not looked at: {refused if status == HTTPStatus.OK else status}")
        memory = (found.get("HostConfig") or {}).get("Tmpfs") or {}
        mounts = {*(str(one["Destination"]) for one in found.get("Mounts") or ()), *map(str, memory)}
        try:
            odd = await self._images.odd(str(found["Image"]), ways(found), mounts)
        except (OSError, ValueError) as error:
            raise RefusedCall(f"its image is not looked at: {error}", HTTPStatus.SERVICE_UNAVAILABLE) from error
        if odd:
            raise RefusedCall(f"its files are not looked at: {odd} is a link in its image, or no file, or a large one")
        self._opened = self._opened if len(self._opened) < _KNOWN else set()
        self._opened.add(container)

    async def stat(self, container: str, path: str, target: str) -> tuple[int, bytes, str]:
        """What is said of a file; of anything else nothing.

        Args:
            container: Its id.
            path: Of the file.
            target: What an engine is asked, by a program that may not read: where a link leads it finds out on the
                machine itself, and mounts the container's volumes for that.
        """
        try:
            told = await self._beneath(container, path, _stat_of)
        except PermissionError:
            await self.may_be_opened(container)
            answer = await self._asking.ask(target, method="HEAD")
            told = pull_stat(answer.headers) if answer.status == HTTPStatus.OK else None
        if told is None or is_odd(told):
            return HTTPStatus.NOT_FOUND, b"", JSON
        return HTTPStatus.OK, b"", f"{STAT}: {push_stat(PurePosixPath(path).name, told)}"

    async def read(self, container: str, path: str) -> tuple[int, bytes, str]:
        """A report, in an archive as an engine would make it.

        By no engine: Docker's process for that has its root in the container, is root of the machine, and looks up the
        names of owners there. It opens whatever a link leads to, and believes what answers and is loaded in there.
        """
        try:
            content = await self._beneath(container, path, _content_of)
        except PermissionError as error:
            raise RefusedCall(f"its files are not read: {error}; {_TODO}") from error
        if content is None:
            return HTTPStatus.NOT_FOUND, b'{"message": "it has no such file"}', JSON
        packed = io.BytesIO()
        with tarfile.open(fileobj=packed, mode="w") as tar:
            entry = tarfile.TarInfo(PurePosixPath(path).name)
            entry.size = len(content)
            tar.addfile(entry, io.BytesIO(content))
        return HTTPStatus.OK, packed.getvalue(), TAR

    async def _beneath(self, container: str, path: str, take: Callable[[int], _T]) -> _T | None:
        """What is made of a file in the volume at `FOLDER`; see `beneath`."""
        status, found = await self._asking.asked(f"/containers/{container}/json")
        mounts = found.get("Mounts") or () if status == HTTPStatus.OK else ()
        folder = next((str(one.get("Source")) for one in mounts if _is_the_volume(one)), None)
        if folder is None:
            return None
        return await asyncio.to_thread(beneath, folder, PurePosixPath(path).relative_to(FOLDER).parts, take)


def _is_the_volume(mount: Mapping[str, Any]) -> bool:
    return (mount.get("Destination"), mount.get("Type"), mount.get("Driver")) == (FOLDER, "volume", "local")


def beneath(folder: str, way: Sequence[str], take: Callable[[int], _T]) -> _T | None:
    """What is made of a plain file in a folder, on a way without links; None: there is no such file.

    Whoever moves things there meanwhile has another file of that folder taken, or none: each step begins at the folder
    that was opened before. What is no plain file is never opened: such a descriptor reads nothing itself.

    Args:
        folder: Nobody else changes its own path.
        way: Folders and the file, by names.
        take: Gets a descriptor of the file, which reads nothing itself.

    Raises:
        PermissionError: This process may not.
    """
    with ExitStack() as opened:
        try:
            here = os.open(folder, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
            opened.callback(os.close, here)
            for name in way:
                here = os.open(name, os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=here)
                opened.callback(os.close, here)
            return take(here) if stat.S_ISREG(os.fstat(here).st_mode) else None
        except PermissionError:
            raise
        except OSError:
            return None


def _content_of(file: int) -> bytes | None:
    """None: it is larger than reports are."""
    with open(f"/proc/self/fd/{file}", "rb", buffering=0, opener=_without_waiting) as opened:
        content = opened.read(MOST_BYTES + 1)
    return content if len(content) <= MOST_BYTES else None


def _without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK)  # for whoever has a lease on it to let go


def _stat_of(file: int) -> dict[str, Any]:
    """As an engine says it."""
    found = os.fstat(file)
    seconds, rest = divmod(found.st_mtime_ns, 10**9)
    when = datetime.fromtimestamp(seconds, UTC)
    return {"size": found.st_size, "mode": found.st_mode & 0o777, "mtime": f"{when:%Y-%m-%dT%H:%M:%S}.{rest:09d}Z"}
