"""Files of volumes go where nobody can have a folder of them any more.

An engine (built with Go before 1.25) removes files by their paths, as root: where a folder becomes a link meanwhile, it
removes what is there, anywhere on the machine. Whoever was given the folder open, by a container that has the volume,
can make it one, though no path leads there for him. So while kin of a volume runs, its files stay.
"""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import Collection, Coroutine, Iterable, Mapping
from http import HTTPStatus
from typing import Any, TypeVar
from urllib.parse import urlencode

from .engine_rules import OWNER
from .kin import Kin
from .machine import Answer, ask, ask_long

_T = TypeVar("_T")
_MOST_TOLD = 32 << 20
"""Bytes of what an engine says of many containers, or of all volumes."""
_CHUNK = 200
"""Containers that are asked for at a time: their ids are a part of the query."""
_WAIT_S = 30.0
"""For a removal of what a start has to do with."""
_SETTLED_S = 3.0
"""For an engine to say what a container is that it does not start just now."""
_MOST_STARTS, _MOST_REMOVALS = 512, 128
"""Under way at a time: an engine may take its time for each, and whoever asked may be gone meanwhile."""
_VOLUME = "volume "
"""What volumes are known by, before their names: they may be named as containers are."""
_OWN = re.compile("[0-9a-f]{64}")
"""Names of volumes that one container has, and no other can ask for."""


class BusyError(Exception):
    """It is not done now; in a sentence."""


class Removals:
    """Starts and removals of one engine: all go by here.

    Each method raises

    - `BusyError`: not now;
    - `OSError`: the engine does not answer;
    - `ValueError`: it says something else.
    """

    def __init__(self, engine: str) -> None:
        """``engine``: path of its socket."""
        self._engine = engine
        self._kin = Kin()
        self._looking = asyncio.Lock()
        self._looked_back = False
        self._starts: dict[str, asyncio.Task[Answer]] = {}
        """By container: before a start has ended, an engine may not yet list it as running."""
        self._mine: set[str] = set()
        """Containers that this program had started: whom those meet that another one started, it does not see."""
        self._noted = 0
        """Starts, so far."""
        self._removals: dict[asyncio.Task[Answer | None], Collection[str]] = {}
        """What of each is removed: no kin of it starts meanwhile."""

    async def start(self, container: str, inspected: Mapping[str, Any], path: str) -> Answer:
        """Have the engine start one, which is kin of what it shares something with from now on."""
        await self.look_back()
        things = (container, *_volumes(inspected), *_joined(inspected))
        if not self._kin.has_room(things):
            await self._forget_ended()
        await self._until_removed(things)
        # From here to the task nobody else comes between.
        if not self._kin.has_room(things) or len(self._starts) >= _MOST_STARTS:
            raise BusyError("too many containers run or start, with too many volumes")
        self._kin.meet(things)
        self._mine.add(container)
        if len(self._mine) > len(self._kin):
            self._mine &= self._kin.all()  # who runs is among these
        self._noted += 1
        if (task := self._starts.get(container)) is None:
            task = self._starts[container] = _begun(ask_long(self._engine, path, method="POST"))
            task.add_done_callback(lambda _: self._starts.pop(container))
        return await asyncio.shield(task)  # it goes on at the engine, whoever waits for it

    async def remove_container(self, container: str, path: str, without: str) -> Answer:
        """Have the engine remove one, with its volumes if nobody else can have a folder of these.

        Args:
            container: Its id.
            path: Path and query by which its volumes go, too.
            without: Those by which they stay.
        """
        await self.look_back()
        answer = await asyncio.to_thread(ask, self._engine, f"/containers/{container}/json")
        if answer.status != HTTPStatus.OK:
            return answer  # it is gone, or nobody knows its volumes
        things = (container, *_volumes(json.loads(answer.content)))
        removed = await self._removed(things, path, itself=container)
        return removed or await ask_long(self._engine, without, method="DELETE")

    async def remove_volume(self, volume: str, path: str) -> Answer:
        """Have the engine remove one; if somebody can have a folder of it, it is in use, as an engine says it."""
        await self.look_back()
        named = not _OWN.fullmatch(volume)
        if (removed := await self._removed((_VOLUME + volume,), path, named=named)) is not None:
            return removed
        text = f"remove {volume}: volume is in use: containers run that may have a folder of it open"
        return Answer(HTTPStatus.CONFLICT, {}, json.dumps({"message": text}).encode())

    async def _removed(
        self, things: Collection[str], path: str, *, itself: str = "", named: bool = False
    ) -> Answer | None:
        """What the engine says to a removal; None: others run, and it was asked for none.

        Args:
            things: What is removed.
            path: By what path and query.
            itself: Who ends before the files are removed.
            named: A volume that whoever knows its name could have, another orchestrator at this engine too.
        """
        if len(self._removals) >= _MOST_REMOVALS:
            raise BusyError("too much is being removed")
        task = _begun(self._remove(things, path, itself, named=named))
        self._removals[task] = things
        task.add_done_callback(self._removals.pop)
        return await asyncio.shield(task)

    async def _remove(self, things: Collection[str], path: str, itself: str, *, named: bool) -> Answer | None:
        kin, starting = self._kin.of(things), set(self._starts)
        if kin & (starting | (await self._running(kin) - {itself})) or (named and await self._strangers_run()):
            return None
        answer = await ask_long(self._engine, path, method="DELETE")
        if answer.status < HTTPStatus.BAD_REQUEST:
            self._kin.forget(things)  # of which none runs
        return answer

    async def _until_removed(self, things: Iterable[str]) -> None:
        """Wait until no kin of these is being removed."""
        try:
            async with asyncio.timeout(_WAIT_S):
                while waits := self._removals_of(things):
                    await asyncio.wait(waits)
        except TimeoutError:
            raise BusyError("a volume is being removed that it may get a folder of") from None

    def _removals_of(self, things: Iterable[str]) -> list[asyncio.Task[Answer | None]]:
        kin = self._kin.of(things) if self._removals else ()
        return [task for task, gone in self._removals.items() if not set(gone).isdisjoint(kin)]

    async def _forget_ended(self) -> None:
        noted, starting = self._noted, set(self._starts)
        running = await self._running(self._kin.all())
        if noted == self._noted:  # or something has started since, of which nobody knows whether it was listed
            self._kin.keep(running | starting)

    async def look_back(self) -> None:
        """Once, before anything is made or started: of what runs already nobody knows what it has met."""
        if not self._looked_back:
            async with self._looking:
                await self._learn()

    async def _learn(self) -> None:
        if self._looked_back:  # meanwhile
            return
        if old := await self._running_or_starting():
            volumes = (await self._told("/volumes"))["Volumes"] or ()
            self._kin.meet([*old, *(f"{_VOLUME}{one['Name']}" for one in volumes)])
        self._looked_back = True

    async def _running_or_starting(self) -> set[str]:
        """A start that an earlier program asked for may be under way: an engine says nothing of it meanwhile.

        If it takes longer, all that may start are taken for such.
        """
        ours = {"label": [OWNER]}
        idle = await self._listed(ours, "all=1&") - await self._listed(ours)
        for container in idle:
            try:
                await asyncio.to_thread(ask, self._engine, f"/containers/{container}/json", patience=_SETTLED_S)
            except (OSError, ValueError):
                return idle | await self._listed(ours)
        return await self._listed(ours)

    async def _running(self, things: Iterable[str]) -> set[str]:
        """Those of these containers that run; all, where an engine says so much of them that nobody reads it."""
        containers, found = [one for one in things if not one.startswith(_VOLUME)], set[str]()
        async with self._looking:  # one at a time, or much that is kin would take all threads
            for first in range(0, len(containers), _CHUNK):
                chunk = containers[first : first + _CHUNK]
                try:
                    found |= await self._listed({"id": chunk, "label": [OWNER]})
                except ValueError:
                    found |= set(chunk)
        return found

    async def _strangers_run(self) -> bool:
        async with self._looking:
            try:
                return not await self._listed({"label": [OWNER]}) <= self._mine
            except ValueError:
                return True

    async def _listed(self, filters: Mapping[str, list[str]], more: str = "") -> set[str]:
        asked = more + urlencode({"filters": json.dumps(filters)})
        return {str(one["Id"]) for one in await self._told(f"/containers/json?{asked}")}

    async def _told(self, path: str) -> Any:
        def tell() -> Any:
            answer = ask(self._engine, path, most=_MOST_TOLD)
            if answer.status != HTTPStatus.OK:
                raise ValueError(f"it answers {answer.status}")
            return json.loads(answer.content)

        return await asyncio.to_thread(tell)


def _begun(work: Coroutine[Any, Any, _T]) -> asyncio.Task[_T]:
    task = asyncio.create_task(work)
    task.add_done_callback(lambda done: done.cancelled() or done.exception())  # whoever asked may be gone
    return task


def _volumes(inspected: Mapping[str, Any]) -> tuple[str, ...]:
    return tuple(f"{_VOLUME}{one['Name']}" for one in inspected.get("Mounts") or () if one.get("Name"))


def _joined(inspected: Mapping[str, Any]) -> tuple[str, ...]:
    """Whose network it is in."""
    _, joins, container = str((inspected.get("HostConfig") or {}).get("NetworkMode")).partition("container:")
    return (container,) if joins else ()
