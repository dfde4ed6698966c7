"""What images have at paths that an engine looks at from the outside; see `archives`."""

from __future__ import annotations

import asyncio
import json
import secrets
from collections.abc import Iterable
from http import HTTPStatus
from urllib.parse import urlencode

from .archives import leads_straight, misleads, must_be_read, pull_stat
from .asking import begun
from .engine_rules import LOOK, NOBODY, OWNER
from .machine import ask_long

_KNOWN = 4096
_MOST_LOOKS, _LOOK_S = 64, 30.0
"""At a time, and how long each is waited for [s]."""
_LOOK_TIMES = 2
"""Another program of a node that begins at this engine takes what is made for a look for left behind, once."""

_Found = dict[tuple[str, str], bool]


class Images:
    """Knows of images what is at paths in there. It looks at each once, however many wait for that.

    Args:
        engine: Path of its socket.
    """

    def __init__(self, engine: str) -> None:
        self._engine = engine
        self._known: _Found = {}
        self._looks: dict[str, asyncio.Task[_Found]] = {}
        """By image; each goes on to its end, whoever waits for it, or the engine keeps what was made for it."""

    async def odd(self, image: str, paths: Iterable[str], mounts: Iterable[str]) -> str | None:
        """One of these paths that is a link in an image, or no file where there must be one; None: none is.

        Args:
            image: Its id.
            paths: In it.
            mounts: Folders in whose place a container has something else. An engine copies nothing of these.

        Raises:
            OSError: The engine does not answer in time.
            ValueError: It does not say.
        """
        wanted, mounts, found = sorted(paths), sorted(mounts), _Found()
        while new := [path for path in wanted if (image, path) not in found]:
            found |= {key: odd for path in new if (odd := self._known.get(key := (image, path))) is not None}
            if not (new := [path for path in new if (image, path) not in found]):
                break
            if (look := self._looks.get(image)) is None:
                if len(self._looks) >= _MOST_LOOKS:
                    raise ValueError("too many images are being looked at")
                look = self._looks[image] = begun(self._look(image, new, mounts))
                look.add_done_callback(lambda _: self._looks.pop(image))
            try:
                async with asyncio.timeout(_LOOK_S):
                    found |= await asyncio.shield(look)
            except TimeoutError:
                raise TimeoutError(f"that takes longer than {_LOOK_S:g} s") from None
        return next((path for path in wanted if found[image, path]), None)

    async def _look(self, image: str, paths: Iterable[str], mounts: Iterable[str]) -> _Found:
        for _ in range(_LOOK_TIMES):
            if (found := await self._look_once(image, paths, mounts)) is not None:
                self._known = {**(self._known if len(self._known) < _KNOWN else {}), **found}
                return found
        raise ValueError("what was made of its image was removed meanwhile")

    async def _look_once(self, image: str, paths: Iterable[str], mounts: Iterable[str]) -> _Found | None:
        """A container is made of it, and never started: nothing moves there. None: somebody removed that meanwhile."""
        body = {
            "Image": image,
            "Entrypoint": ["/never-started"],
            "Labels": {OWNER: NOBODY},  # or the image could say that it is an orchestrator's, which could start it
            "HostConfig": {
                "NetworkMode": "none",
                "ReadonlyRootfs": True,
                "CapDrop": ["ALL"],
                "SecurityOpt": ["no-new-privileges"],
                "Mounts": [{"Type": "tmpfs", "Target": path} for path in mounts],
            },
        }
        name = f"{LOOK}{secrets.token_hex(4)}"
        made = await ask_long(self._engine, f"/containers/create?name={name}", method="POST", body=body)
        if made.status != HTTPStatus.CREATED:
            raise ValueError(f"its image cannot be looked at: {made.content[:200].decode(errors='replace')}")
        container = json.loads(made.content)["Id"]
        try:
            found = {(image, path): await self._misleads(container, path) for path in paths}
        except BaseException:
            await self._remove(container)
            raise
        return found if await self._remove(container) else None  # or nothing was found because nothing was there

    async def _remove(self, container: str) -> bool:
        removed = await ask_long(self._engine, f"/containers/{container}?force=1&v=1", method="DELETE")
        return removed.status < HTTPStatus.BAD_REQUEST

    async def _misleads(self, container: str, path: str) -> bool:
        asks = f"/containers/{container}/archive?{urlencode({'path': path})}"
        answer = await ask_long(self._engine, asks, method="HEAD")
        if answer.status == HTTPStatus.NOT_FOUND:
            return False
        if answer.status != HTTPStatus.OK:
            raise ValueError(f"its engine says {answer.status} to {path}")
        stat = pull_stat(answer.headers)
        if stat is None:
            raise ValueError(f"its engine says nothing of {path}")
        if misleads(path, stat):
            return True
        if not must_be_read(path, stat):
            return False
        link = await ask_long(self._engine, asks, method="GET")
        return link.status != HTTPStatus.OK or not leads_straight(link.content, stat["linkTarget"])
