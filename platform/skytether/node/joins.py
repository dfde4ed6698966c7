"""A container whose network another one joins is paused meanwhile, and not ended.

An engine names that network by the number of a process. If that ended before runc looks, another process could have its
number: one of the machine, whose network the container would be in. Where the memory of the machine is used up, the
kernel ends what is paused, too: so nobody else gets that number meanwhile (`shims`). Where that cannot be seen to, who
joins is ended as soon as it has a process.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Awaitable, Callable
from http import HTTPStatus
from itertools import chain, repeat
from typing import TypeVar

from . import shims
from .asking import begun, conflict, killed
from .join_watch import JoinWatch, Life
from .machine import Answer, ask_long

log = logging.getLogger(__name__)

_T = TypeVar("_T")
_WAIT_S = 30.0
"""For those that just join, before one is ended."""
_TRY_S = (0.0, 0.1, 1.0, 5.0, 10.0)
"""Between tries to have a container go on that was paused, or ended."""
_MOST_JOIN, _MOST_ENDING = 4, 16
"""In line for one network, and calls under way by which one container may end: an engine may take its time for each,
and whoever asked may be gone meanwhile."""
_ENDS = "the container whose network it joins is being ended"
_HAS_ENDED = (
    "the container whose network it joins has ended, or cannot be kept as it is now, as far as the kernel shows it "
    "(/proc, /sys/fs/cgroup)"
)
_ENDED = "the container whose network it joined ended meanwhile: it was ended, too"


class BusyError(Exception):
    """It is not done now; in a sentence."""


class Joins:
    """Of one engine."""

    def __init__(self, engine: str) -> None:
        """``engine``: path of its socket."""
        self._engine = engine
        self._joined: Counter[str] = Counter()
        """How many join the network of each just now."""
        self._pauses: dict[str, asyncio.Lock] = {}
        """They do one at a time."""
        self._ending: Counter[str] = Counter()
        """Of calls by which a container may end."""
        self._noted = False
        """Whether it was told that numbers cannot be held."""

    def may_join(self, joined: str, *, new: bool) -> None:
        """Raises `BusyError` where no container joins the network of that one now; ``new``: nor is it about to."""
        if joined in self._ending:
            raise BusyError(_ENDS)
        if new and self._joined[joined] >= _MOST_JOIN:
            raise BusyError("too many containers join that network just now")

    def is_joined(self, container: str) -> bool:
        """Whether another one joins its network just now."""
        return container in self._joined

    def start(self, container: str, path: str, joined: str) -> asyncio.Task[Answer]:
        """Have the engine start one by ``path``, with the one paused whose network it joins."""
        self._joined[joined] += 1
        return begun(self._start(container, path, joined))

    async def _start(self, container: str, path: str, joined: str) -> Answer:
        try:
            async with self._pauses.setdefault(joined, asyncio.Lock()):
                if joined in self._ending:
                    raise BusyError(_ENDS)
                paused, ends = None, False
                try:
                    paused = await ask_long(self._engine, f"/containers/{joined}/pause", method="POST")
                    if paused.status >= HTTPStatus.BAD_REQUEST:
                        return paused  # it has ended, or is about to, or somebody else has it paused
                    return await self._start_beside(container, path, joined)
                except BaseException as error:
                    # If this program does, the engine goes on with that start, and the next program lets both go on.
                    ends = not isinstance(error, Exception)
                    raise
                finally:
                    if not ends and (paused is None or paused.status < HTTPStatus.BAD_REQUEST):
                        await self._go_on(joined)
        finally:
            self._has_joined(joined)

    async def _start_beside(self, container: str, path: str, joined: str) -> Answer:
        """With that one paused."""
        life = await Life(self._engine, joined).begin()
        if not life.is_known():
            raise BusyError("its engine says nothing of the container whose network it joins")
        held = shims.stop(joined, life.first())
        if held is False or life.has_ended():
            raise BusyError(_HAS_ENDED)
        self._note(held)
        starts = begun(ask_long(self._engine, path, method="POST"))
        watch = JoinWatch(self._engine, joined, (container,), life)
        try:
            await asyncio.wait((starts,))
        finally:
            watch.close()
        if not await life.goes_on():
            await self.end_joined(container)
            return conflict(_ENDED)
        return starts.result()

    def _has_joined(self, joined: str) -> None:
        self._joined[joined] -= 1
        if not self._joined[joined]:
            del self._joined[joined], self._pauses[joined]

    async def end_joined(self, container: str) -> None:
        """End one that may be in another network than the one that it was to join."""
        for wait_s in _TRY_S:
            await asyncio.sleep(wait_s)
            if await killed(self._engine, container):
                log.warning("container %s was ended: the one whose network it joined ended meanwhile", container)
                return
        log.error("container %s may be in the network of this machine: docker kill %s", container, container)

    def _note(self, held: bool | None) -> None:
        if held is None and not self._noted:
            self._noted = True
            log.warning(
                "its engine's processes beside containers cannot be stopped (another user's, or hidden from this one): "
                "who joins a network whose container ends in that moment may be in this machine's until it is ended"
            )

    async def _go_on(self, container: str) -> None:
        refused = 0
        for wait_s in chain(_TRY_S, repeat(_TRY_S[-1])):
            await asyncio.sleep(wait_s)
            try:
                shims.resume(container)  # nobody has a container go on without it
                answer = await ask_long(self._engine, f"/containers/{container}/unpause", method="POST")
            except (OSError, ValueError):
                continue  # it will be back, perhaps with all that ran
            if answer.status < HTTPStatus.INTERNAL_SERVER_ERROR or b"not paused" in answer.content:
                return
            refused += 1
            if refused == len(_TRY_S):
                break
        log.error("container %s stays paused: docker unpause %s", container, container)

    async def let_go_on(self, container: str, joining: Callable[[], Awaitable[None]]) -> None:
        """Have one go on, later, that an earlier program may have paused; nobody joins its network, or ends it, before.

        Args:
            container: Its id.
            joining: Waits for those that joined its network then. The engine may never let it end, if what runs there
                sees to that.
        """
        if container in self._pauses:  # it is paused for who joins just now, or is about to be let go on
            return
        lock = self._pauses[container] = asyncio.Lock()
        self._joined[container] += 1
        await lock.acquire()
        begun(self._go_on_after(container, joining))

    async def _go_on_after(self, container: str, joining: Callable[[], Awaitable[None]]) -> None:
        try:
            await joining()
            await self._go_on(container)
        finally:
            self._pauses[container].release()
            self._has_joined(container)

    async def end(self, container: str, work: Callable[[], Awaitable[_T]]) -> _T:
        """Have something done by which a container may end, which it must not while another one joins its network.

        Who joins it just now is waited for; who wants to, does not any more.
        """
        if self._ending[container] >= _MOST_ENDING:
            raise BusyError("too much is asked of that container just now")
        self._ending[container] += 1
        try:
            if (joining := self._pauses.get(container)) is not None:
                try:
                    async with asyncio.timeout(_WAIT_S):
                        await joining.acquire()
                except TimeoutError:
                    raise BusyError("another container is just joining its network") from None
                joining.release()
            return await work()
        finally:
            self._ending[container] -= 1
            if not self._ending[container]:
                del self._ending[container]
