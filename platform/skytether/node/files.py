"""Files in containers, as far as an orchestrator is told of them."""

from __future__ import annotations

import asyncio
import io
import os
import stat
import tarfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from http import HTTPStatus
from pathlib import PurePosixPath
from typing import Any

from skytether.api.service_report import MOST_BYTES

from .archives import STAT, Images, is_odd, moved, pull_stat, push_stat, ways
from .asking import JSON, TAR, Asking, RefusedCall
from .engine_rules import FOLDER

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
        self._looking = asyncio.Lock()

    async def may_be_opened(self, container: str) -> None:
        """Raises `RefusedCall` unless the engine may look into its files, or it is gone."""
        if container in self._opened:
            return
        status, found = await self._asking.asked(f"/containers/{container}/json")
        if status == HTTPStatus.NOT_FOUND:
            return
        if status != HTTPStatus.OK or (refused := moved(found)):
            raise RefusedCall(f"its files are not looked at: {refused if status == HTTPStatus.OK else status}")
        try:
            async with self._looking:
                odd = await asyncio.to_thread(self._images.odd, str(found["Image"]), ways(found))
        except (OSError, ValueError) as error:
            raise RefusedCall(f"its image is not looked at: {error}", HTTPStatus.SERVICE_UNAVAILABLE) from error
        if odd:
            raise RefusedCall(f"its files are not looked at: {odd} is a link in its image, or no file, or a large one")
        self._opened = self._opened if len(self._opened) < _KNOWN else set()
        self._opened.add(container)

    async def stat(self, target: str) -> tuple[int, bytes, str]:
        """What is said of a file; of a link nothing: where it leads an engine finds out on the machine itself."""
        answer = await self._asking.ask(target, method="HEAD")
        told = pull_stat(answer.headers) if answer.status == HTTPStatus.OK else None
        if told is None or is_odd(told):
            return HTTPStatus.NOT_FOUND, b"", JSON
        return HTTPStatus.OK, b"", f"{STAT}: {push_stat(told)}"

    async def read(self, container: str, path: str) -> tuple[int, bytes, str]:
        """A report, in an archive as an engine would make it.

        By no engine: Docker's process for that has its root in the container, is root of the machine, and looks up the
        names of owners there. It opens whatever a link leads to, and believes what answers and is loaded in there.
        """
        status, found = await self._asking.asked(f"/containers/{container}/json")
        mounts = found.get("Mounts") or () if status == HTTPStatus.OK else ()
        folder = next((str(one.get("Source")) for one in mounts if _is_the_volume(one)), None)
        way = PurePosixPath(path).relative_to(FOLDER).parts
        try:
            content = None if folder is None else await asyncio.to_thread(read_beneath, folder, way, MOST_BYTES)
        except PermissionError as error:
            raise RefusedCall(f"its files are not read: {error}; {_TODO}") from error
        if content is None:
            return HTTPStatus.NOT_FOUND, b'{"message": "it has no such file"}', JSON
        packed = io.BytesIO()
        with tarfile.open(fileobj=packed, mode="w") as tar:
            entry = tarfile.TarInfo(way[-1])
            entry.size = len(content)
            tar.addfile(entry, io.BytesIO(content))
        return HTTPStatus.OK, packed.getvalue(), TAR


def _is_the_volume(mount: Mapping[str, Any]) -> bool:
    return (mount.get("Destination"), mount.get("Type"), mount.get("Driver")) == (FOLDER, "volume", "local")


def read_beneath(folder: str, way: Sequence[str], most: int) -> bytes | None:
    """What is in a file in a folder, on a way without links; None: there is no such file, or it is larger.

    Whoever moves things there meanwhile has another file of that folder read, or none: each step begins at the folder
    that was opened before. Nothing but a plain file is opened: the descriptor that is looked at reads nothing itself.

    Args:
        folder: Nobody else changes its own path.
        way: Folders and the file, by names.
        most: Bytes.

    Raises:
        PermissionError: This process may not.
    """
    with ExitStack() as opened:

        def enter(name: str, flags: int, **at: int) -> int:
            descriptor = os.open(name, flags | os.O_CLOEXEC, **at)
            opened.callback(os.close, descriptor)
            return descriptor

        try:
            here = enter(folder, os.O_PATH | os.O_DIRECTORY)
            for name in way:
                here = enter(name, os.O_PATH | os.O_NOFOLLOW, dir_fd=here)
            if not stat.S_ISREG(os.fstat(here).st_mode):
                return None
            content = os.read(enter(f"/proc/self/fd/{here}", os.O_RDONLY | os.O_NONBLOCK), most + 1)
        except PermissionError:
            raise
        except OSError:
            return None
    return content if len(content) <= most else None
