"""Files in containers, as far as an engine may look at them for an orchestrator, and what is told of them."""

from __future__ import annotations

import asyncio
import json
from http import HTTPStatus

from skytether.api.service_report import MOST_BYTES

from .archives import STAT, Images, is_odd, moved, pull_stat, push_stat, ways
from .asking import JSON, TAR, Asking, RefusedCall
from .names import loads_late
from .removals import BusyError, begun

_MOST_FILE = MOST_BYTES + (8 << 10)
"""Of the archive of one file, which is one of reports: the file, and some heads of 512 bytes."""
_KNOWN = 4096
"""Containers and images that are remembered."""
_LOOK_THROUGH_S = 1.0
"""That somebody who asks for a file waits for a look through its image, which goes on if it takes longer."""
_AGAIN_S = 300.0
"""Until an image is looked through again in which an engine hung: it holds up looks at others."""


class Files:
    """Of one engine's containers. What is answered: status, content, and a row for the head.

    Args:
        engine: Path of its socket.
        asking: Asks it.
    """

    def __init__(self, engine: str, asking: Asking) -> None:
        self._asking = asking
        self._images = Images(engine)
        self._opened: dict[str, str] = {}
        """Containers into whose files the engine may look, and their images."""
        self._looks: dict[str, asyncio.Task[str | None]] = {}
        """By image that is looked through, or was."""
        self._looking, self._looking_through = asyncio.Lock(), asyncio.Lock()

    async def may_be_opened(self, container: str) -> str:
        """Its image, empty if it is gone; raises unless the engine may look into its files."""
        if container in self._opened:
            return self._opened[container]
        status, found = await self._asking.asked(f"/containers/{container}/json")
        if status == HTTPStatus.NOT_FOUND:
            return ""
        if status != HTTPStatus.OK or (refused := moved(found)):
            raise RefusedCall(f"its files are not looked at: {refused if status == HTTPStatus.OK else status}")
        try:
            async with self._looking:
                odd = await asyncio.to_thread(self._images.odd, str(found["Image"]), ways(found))
        except (OSError, ValueError) as error:
            raise RefusedCall(f"its image is not looked at: {error}", HTTPStatus.SERVICE_UNAVAILABLE) from error
        if odd:
            raise RefusedCall(f"its files are not looked at: {odd} is a link in its image, or no file, or a large one")
        self._opened = self._opened if len(self._opened) < _KNOWN else {}
        self._opened[container] = str(found["Image"])
        return self._opened[container]

    async def stat(self, target: str) -> tuple[int, bytes, str]:
        """What is said of a file; of a link nothing: where it leads an engine finds out on the machine itself."""
        answer = await self._asking.ask(target, method="HEAD")
        stat = pull_stat(answer.headers) if answer.status == HTTPStatus.OK else None
        if stat is None or is_odd(stat):
            return HTTPStatus.NOT_FOUND, b"", JSON
        return HTTPStatus.OK, b"", f"{STAT}: {push_stat(stat)}"

    async def read(self, container: str, target: str) -> tuple[int, bytes, str]:
        """An engine that waits until somebody takes the rest of a file lets nobody end its container."""
        if image := await self.may_be_opened(container):
            if late := await asyncio.to_thread(loads_late):
                raise RefusedCall(f"its files are not read: {late}")
            try:
                if odd := await self._device(image):
                    raise RefusedCall(f"its files are not read: in its image, {odd}")
            except BusyError as error:
                return HTTPStatus.SERVICE_UNAVAILABLE, json.dumps({"message": str(error)}).encode(), JSON
            except (OSError, ValueError) as error:
                why = f"its image is not looked through: {error}"
                raise RefusedCall(why, HTTPStatus.SERVICE_UNAVAILABLE) from error
        answer = await self._asking.ask(target, most=_MOST_FILE + 1)
        if len(answer.content) > _MOST_FILE:
            raise RefusedCall("the file is larger than those that a site asks for")
        if answer.status != HTTPStatus.OK:  # in words that name files of the machine, perhaps
            return HTTPStatus.NOT_FOUND, b'{"message": "it has no such file"}', JSON
        return HTTPStatus.OK, answer.content, TAR

    async def _device(self, image: str) -> str | None:
        """As `Images.device`; raises `BusyError` while that is not known yet. It is found out once."""
        busy = BusyError(f"image {image} is being looked through for files of devices: ask again")
        if image not in self._looks:
            if len(self._looks) >= _KNOWN:
                self._looks = {one: task for one, task in self._looks.items() if not task.done()}
            if len(self._looks) >= _KNOWN:
                raise busy
            self._looks[image] = begun(self._look_through(image))
        task = self._looks[image]
        await asyncio.wait((task,), timeout=_LOOK_THROUGH_S)
        if not task.done():
            raise busy
        return task.result()

    async def _look_through(self, image: str) -> str | None:
        async with self._looking_through:
            try:
                return await asyncio.to_thread(self._images.device, image)
            except (OSError, ValueError) as error:  # whoever asks again has it tried again
                after_s = _AGAIN_S if isinstance(error, OSError) else 0.0
                asyncio.get_running_loop().call_later(after_s, self._looks.pop, image, None)
                raise
