"""Files of volumes go where nobody can have a folder of them any more.

An engine (built with Go before 1.25) removes files by their paths, as root: where a folder becomes a link meanwhile, it
removes what is there, anywhere on the machine. Whoever was given the folder open, by a container that has the volume,
can make it one, though no path leads there for him. So while kin of a volume runs, its files stay.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import re
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Collection, Container, Iterable, Mapping
from functools import partial
from http import HTTPStatus
from math import inf
from typing import Any, TypeVar
from urllib.parse import urlencode

from . import shims
from .asking import begun, conflict, state_of
from .cgroups import Cgroups
from .engine_rules import LOOKS, NOBODY, OWNER
from .join_watch import PATIENCE_S, JoinWatch, Life
from .joins import BusyError, Joins
from .kin import Kin
from .machine import Answer, TooMuchError, ask_long, ask_soon, lean, listed, picked

log = logging.getLogger(__name__)

_T = TypeVar("_T")
_LOOK_BACK_S = 15.0
"""In which containers are asked for, one by one, whether they run; after that, each is taken to."""
_WAIT_S = 30.0
"""For a removal of what a start has to do with."""
_QUIET_S = 15.0
"""For what an earlier program asked for to begin at the engine: starts, removals, and what pauses or ends a container.
Of what ends one there are few, and an engine is at these in turn."""
_LIST_AGAIN_S = 60.0
_IDLE_S = 0.5
"""Between looks at one that may be about to start."""
_OWN = re.compile("[0-9a-f]{64}")
"""Names of volumes that one container has, and no other can ask for."""
_MOST_STARTS, _MOST_REMOVALS, _MOST_PUTS = 512, 128, 8
"""Under way at a time, the last into one container: an engine may take its time for each, and whoever asked may be gone
meanwhile."""
_MOST_MINE = 1 << 15
_MOST_TOLD = 100
_MOST_ASKED = 32
"""Containers that are asked for at a time: of one that an engine just starts it says nothing for some seconds."""
_MODE = "HostConfig.NetworkMode"
_OURS = urlencode({"all": "1", "filters": json.dumps({"label": [OWNER]})})
"""What asks an engine for all containers of orchestrators."""
_VOLUME = "volume "
"""What volumes are known by, before their names: they may be named as containers are."""


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
        self._looked_back, self._began = False, time.time()
        self._quiet_from = inf
        """When that has begun; counted from the engine's first answer, for before that it may have been held up."""
        self._learning: asyncio.Task[None] | None = None
        self._starts: dict[str, asyncio.Task[Answer]] = {}
        """By container: before a start has ended, an engine may not yet list it as running."""
        self._mine: set[str] = set()
        """Containers that this program had started: whom those meet that another one started, it does not see."""
        self._old: set[str] | None = None
        """Containers that were there before this program, so long as they are; None: the engine has not listed any yet.

        What an earlier program asked for of one may wait at the engine, a start too, and the engine says meanwhile that
        it does not run.
        """
        self._puts: Counter[str] = Counter()
        """How much is being put into each container."""
        self._joins = Joins(engine)
        self._told: set[str] = set()
        """Containers of whose processes it was told that they go on."""
        self._noted = 0
        """Starts, so far."""
        self._removals: dict[asyncio.Task[Answer | None], Collection[str]] = {}
        """What of each is removed: no kin of it starts meanwhile."""

    async def start(self, container: str, inspected: Mapping[str, Any], path: str) -> Answer:
        """Have the engine start one, which is kin of what it shares something with from now on."""
        volumes, joins = _volumes(inspected), _joined(inspected)
        things = (container, *volumes, *joins)
        del inspected  # it may be large, and from here on much is waited for
        await self._know_old()
        if self._is_old(container):  # what an earlier program was asked for may meet it as it runs
            text = f"container {container} was there before this node's program began: remove it, and make another"
            return conflict(text)
        # An earlier program may have been asked to end it, or to remove it.
        if any(map(self._is_old, joins)) or any(not _OWN.fullmatch(one.removeprefix(_VOLUME)) for one in volumes):
            await asyncio.sleep(self._quiet_from - time.monotonic())
        if not self._kin.lost and not self._kin.has_room(things):
            await self._forget_ended()
        await self._until_removed(things)
        # From here to the task nobody else comes between.
        if len(self._starts) >= _MOST_STARTS:
            raise BusyError("too many containers start")
        if self._puts[container]:
            raise BusyError("something is being put into it")
        if self._joins.is_joined(container):  # who joins it could not be told from one that joins what was before it
            raise BusyError("another container is just joining its network")
        for joined in joins:
            self._joins.may_join(joined, new=container not in self._starts)
        self._kin.meet(things)
        self._mine.add(container)
        if len(self._mine) > _MOST_MINE:
            self._mine &= self._kin.all() | self._starts.keys() | {container}
        self._noted += 1
        if (task := self._starts.get(container)) is None:
            if joins:
                task = self._joins.start(container, path, *joins)
            else:
                task = begun(ask_long(self._engine, path, method="POST"))
            self._starts[container] = task
            task.add_done_callback(lambda _: self._starts.pop(container))
        return await asyncio.shield(task)  # it goes on at the engine, whoever waits for it

    async def end(self, container: str, work: Callable[[], Awaitable[_T]]) -> _T:
        """See `Joins.end`."""
        with contextlib.suppress(TooMuchError):  # what is too much to list is to be ended still
            await self._know_old()
        return await self._joins.end(container, work)

    async def put(self, container: str, path: str, archive: bytes, own: str = "") -> Answer | None:
        """Have the engine unpack an archive in one that was never started; None: it was, or has no such volume.

        An engine writes through a link to a device of the image that somebody makes there meanwhile: what runs in it,
        or another one that has its volume.

        Args:
            container: Its id.
            path: Path and query.
            archive: What is unpacked.
            own: Where a volume must be that it alone has, for files are written there; empty: there is no file.
        """
        await self._know_old()
        answer = await ask_soon(self._engine, f"/containers/{container}/json")
        takes = answer.status == HTTPStatus.OK and _takes_files(answer.content, own)
        del answer  # it may be large, and the engine may take any time
        if container in self._mine or self._is_old(container) or not takes:
            return None
        if self._puts[container] >= _MOST_PUTS:
            raise BusyError("too much is being put into it")
        self._puts[container] += 1
        task = begun(ask_long(self._engine, path, method="PUT", body=archive))
        task.add_done_callback(lambda _: self._has_put(container))
        return await asyncio.shield(task)  # the engine goes on with it, whoever waits for it: no start overtakes it

    def _has_put(self, container: str) -> None:
        self._puts[container] -= 1
        if not self._puts[container]:
            del self._puts[container]

    async def remove_container(self, container: str, path: str) -> Answer:
        """Have the engine remove one, and then those of its volumes that nobody else can have a folder of.

        Args:
            container: Its id.
            path: Path and query by which its volumes stay.
        """
        await self.look_back()
        answer = await ask_soon(self._engine, f"/containers/{container}/json")
        if answer.status != HTTPStatus.OK:
            return answer  # it is gone, or nobody knows its volumes
        volumes = _volumes(lean(answer.content))
        del answer  # it may be large, and the engine may take any time
        removed = await ask_long(self._engine, path, method="DELETE")
        if removed.status < HTTPStatus.BAD_REQUEST:
            for volume in (one.removeprefix(_VOLUME) for one in volumes):
                if _OWN.fullmatch(volume):
                    with contextlib.suppress(BusyError):  # it has a label by which it is found again
                        await self._removed((_VOLUME + volume,), f"/volumes/{volume}")
        return removed

    async def remove_volume(self, volume: str, path: str) -> Answer:
        """Have the engine remove one; if somebody can have a folder of it, it is in use, as an engine says it."""
        await self.look_back()
        named = not _OWN.fullmatch(volume)
        if (removed := await self._removed((_VOLUME + volume,), path, named=named)) is not None:
            return removed
        text = f"remove {volume}: volume is in use: containers run that may have a folder of it open, or go on"
        return conflict(text)

    async def _removed(self, things: Collection[str], path: str, *, named: bool = False) -> Answer | None:
        """What the engine says to a removal; None: others run, and it was asked for none.

        Args:
            things: What is removed.
            path: By what path and query.
            named: A volume that whoever knows its name could have, another orchestrator at this engine too.
        """
        if self._kin.lost:
            await self._find_again()
        if self._kin.lost:
            return None
        if len(self._removals) >= _MOST_REMOVALS:
            raise BusyError("too much is being removed")
        task = begun(self._remove(things, path, named=named))
        self._removals[task] = things
        task.add_done_callback(self._removals.pop)
        return await asyncio.shield(task)

    async def _remove(self, things: Collection[str], path: str, *, named: bool) -> Answer | None:
        kin, starting = set(self._kin.of(things)), set(self._starts)
        if kin & (starting | await self._running(kin)) or (named and await self._anybody_runs(self._mine)):
            return None  # among them, perhaps, whom another program of a node started
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
        try:
            async with asyncio.timeout(_LOOK_BACK_S):
                running = await self._running(self._kin.all())
        except TimeoutError:
            self._kin.lose()
            return
        if noted == self._noted:  # or something has started since, of which nobody knows whether it was listed
            self._kin.keep(running | starting)

    async def _find_again(self) -> None:
        """Know again who met whom, if nobody runs."""
        noted = self._noted
        if not self._starts and not await self._anybody_runs() and noted == self._noted:
            self._kin.keep(())

    async def look_back(self) -> None:
        """Once, before anything is made or started: of what runs already nobody knows what it has met."""
        if not self._looked_back:
            if self._learning is None or self._learning.done():
                self._learning = begun(self._learn())
            await asyncio.shield(self._learning)  # to its end, whoever waits for it

    async def _learn(self) -> None:
        async with self._looking:
            await self._learn_all()

    async def _learn_all(self) -> None:
        asked_until = time.monotonic() + _LOOK_BACK_S
        try:
            there = {one["Id"]: one for one in await self._containers() if not self._is_left(one)}
            old = {one for one in there if time.monotonic() > asked_until or await self._may_run(one)}
            if old := old | await self._going_on(there):
                volumes = await asyncio.to_thread(listed, self._engine, "/volumes", ["Volumes.item"], ["Name"])
                self._kin.meet([*old, *(f"{_VOLUME}{one['Name']}" for one in volumes)])
        except (TooMuchError, TimeoutError):  # it has so much that it takes long to tell
            self._kin.lose()
        self._looked_back = True

    async def _let_go_on(self, old: Mapping[str, Mapping[str, Any]]) -> None:
        """An earlier program may have ended while it had some paused, for others that joined their networks."""
        joining, asked_until = dict[str, list[str]](), time.monotonic() + _LOOK_BACK_S
        for one in old:
            joining.setdefault(str(old[one].get(_MODE)).removeprefix("container:"), []).append(one)
        for container in old:
            joins, paused = joining.get(container, []), old[container].get("State") == "paused"
            if joins and not paused:  # so a list says, where the engine could not write down that it is
                paused = time.monotonic() > asked_until or await self._is_paused(container)
            if paused:
                await self._joins.let_go_on(container, partial(self._until_joined, container, joins))
            elif joins and self._old is None:  # it may have ended as they joined it
                begun(self._until_joined(container, joins))

    async def _is_said_to_run(self, container: str) -> bool:
        """Of one that an engine starts it says nothing."""
        state = await state_of(self._engine, container, patience=PATIENCE_S)
        return state is not None and state.get("Running") is not False

    async def _is_paused(self, container: str) -> bool:
        """Whether it is, or may be."""
        state = await state_of(self._engine, container, patience=PATIENCE_S)
        return state is None or state.get("Paused") is not False

    async def _until_joined(self, container: str, joining: Collection[str]) -> None:
        """Wait until a container's network is not being joined any more; who joined another's by that is ended.

        Args:
            container: Its id.
            joining: Those that are to be in its network.
        """
        life = await Life(self._engine, container).begin(patience=PATIENCE_S)
        idle = await self._idle(joining)  # a start of theirs may be under way
        watch = JoinWatch(self._engine, container, idle, life, first_look_s=0.0)
        try:
            for one in joining:
                while await self._runs(one) is False and time.monotonic() < self._quiet_from:
                    await asyncio.sleep(_IDLE_S)
                while not await self._is_told_of(one):
                    await asyncio.sleep(PATIENCE_S)
                if one in idle and await self._runs(one) and not await life.goes_on():
                    await self._joins.end_joined(one)
                watch.has_joined(one)
        finally:
            watch.close()
        with contextlib.suppress(OSError):
            shims.resume(container)

    async def _idle(self, containers: Collection[str]) -> set[str]:
        """Those that an engine does not say to run; all are asked for at once, for of some it may say nothing."""
        turns = asyncio.Semaphore(_MOST_ASKED)

        async def runs(container: str) -> bool:
            async with turns:
                return await self._is_said_to_run(container)

        told = await asyncio.gather(*map(runs, containers))
        return {one for one, running in zip(containers, told, strict=True) if not running}

    async def _look_again(self) -> None:
        """When all has begun that an earlier program asked for: it may have paused one after the list was told."""
        while True:
            await asyncio.sleep(self._quiet_from - time.monotonic())
            try:
                there = {one["Id"]: one for one in await self._containers()}
            except (OSError, ValueError):
                await asyncio.sleep(_LIST_AGAIN_S)
            else:
                return await self._let_go_on({one: there[one] for one in there if self._is_old(one)})

    def _is_left(self, container: Mapping[str, Any]) -> bool:
        """Whether an earlier program made it to look at an image, and had no time to remove it; then it is removed."""
        name, made = str(container.get("Names.item")), float(container.get("Created") or inf)
        left = container.get(f"Labels.{OWNER}") == NOBODY and LOOKS.fullmatch(name) and made < self._began
        if left:
            begun(ask_long(self._engine, f"/containers/{container['Id']}?force=1&v=1", method="DELETE"))
        return bool(left)

    async def _running(self, things: Iterable[str]) -> set[str]:
        """Those of these containers that run, or may."""
        found, ended = set[str](), dict[str, int]()
        waiting = iter([one for one in things if not one.startswith(_VOLUME)])

        async def look() -> None:
            for container in waiting:
                noted = self._noted
                if await self._may_run(container) or noted != self._noted:  # or it may have been started since
                    found.add(container)
                else:
                    ended[container] = noted

        async with self._looking:
            await asyncio.gather(*(look() for _ in range(_MOST_ASKED)))
            cgroups = await asyncio.to_thread(
                Cgroups
            )  # after it was asked: what has started since, and ended, is there
            for container, noted in ended.items():
                if self._goes_on(container, cgroups):
                    found.add(container)
                elif noted == self._noted and container not in self._starts:
                    self._kin.leave(container)
        return found

    async def _may_run(self, container: str) -> bool:
        """Whether it runs, or may."""
        runs = await self._runs(container)
        if runs is None and self._old is not None:
            self._old.discard(container)
        return runs is not None and (runs or self._is_old(container))

    async def _runs(self, container: str) -> bool | None:
        """Whether the engine says that it runs, or nothing; None: that there is no such container.

        Each is asked for: with a full disk, an engine (20.10) may start one that its list never says to run. It says
        nothing of one that it starts just now, as an earlier program may have asked it to.
        """
        try:
            answer = await ask_soon(self._engine, f"/containers/{container}/json", patience=PATIENCE_S)
            if answer.status == HTTPStatus.NOT_FOUND:
                return None
            return picked(answer.content, "State", "Running")["State"]["Running"] is not False
        except (OSError, ValueError, LookupError, TypeError):
            return True

    async def _know_old(self) -> None:
        """Look back, and have the engine list what was there, where it could not do that at the look back."""
        await self.look_back()
        if self._old is None:
            await self._containers()

    def _is_old(self, container: str) -> bool:
        return self._old is None or container in self._old

    def _goes_on(self, container: str, cgroups: Cgroups) -> bool:
        """Whether processes of a container go on of which the engine says that it does not run."""
        if not cgroups.go_on(container):
            return False
        if container not in self._told and len(self._told) < _MOST_TOLD:
            self._told.add(container)
            ends = cgroups.kill(container)
            log.warning("processes of container %s go on though it has ended; volumes stay until %s", container, ends)
        return True

    async def _going_on(self, known: Collection[str], but: Container[str] = ()) -> set[str]:
        """Containers whose processes go on: of those that the engine lists, and of those that it knows nothing of."""
        cgroups = await asyncio.to_thread(Cgroups)
        found = {one for one in known if one not in but and cgroups.go_on(one)}
        for container in cgroups.of_docker():
            if container not in known and container not in but and cgroups.go_on(container):
                gone = True
                with contextlib.suppress(OSError, ValueError):  # who says nothing says not that it knows it
                    path = f"/containers/{container}/json"
                    answer = await ask_soon(self._engine, path, patience=PATIENCE_S)
                    gone = answer.status == HTTPStatus.NOT_FOUND
                if gone and self._goes_on(container, cgroups):
                    found.add(container)
        return found

    async def _is_told_of(self, container: str) -> bool:
        """Whether an engine says anything of it: not while it starts it."""
        try:
            await ask_soon(self._engine, f"/containers/{container}/json", patience=PATIENCE_S)
        except (OSError, ValueError):
            return False
        return True

    async def _anybody_runs(self, but: Collection[str] = ()) -> bool:
        """Whether any container of orchestrators may run, but for these."""
        async with self._looking:
            try:
                there = await self._containers()
            except ValueError:
                return True
            for one in sorted(there, key=lambda one: one.get("State") != "running"):
                if one["Id"] not in but and await self._may_run(one["Id"]):
                    return True
            return bool(await self._going_on({one["Id"] for one in there}, but))

    async def _containers(self) -> list[dict[str, Any]]:
        """All of orchestrators."""
        keys = ("Id", "State", _MODE, "Names.item", f"Labels.{OWNER}", "Created")
        there = await asyncio.to_thread(listed, self._engine, f"/containers/json?{_OURS}", ["item"], keys)
        if self._old is None:  # the first that is told: at the look back it may have been too much
            self._quiet_from = time.monotonic() + _QUIET_S
            await self._let_go_on({one["Id"]: one for one in there})
            self._old = {one["Id"] for one in there}
            begun(self._look_again())
        return there


def _takes_files(content: bytes, own: str) -> bool:
    """Whether a container was never started, and has a volume that it alone has at a path; empty: at none."""
    found = picked(content, "State", "Status", "ExitCode", "Error", "Mounts", "Destination", "Name")
    state = found.get("State") or {}
    fresh = state.get("Status") == "created" and not state.get("ExitCode") and not state.get("Error")
    names = [str(one.get("Name")) for one in found.get("Mounts") or () if one.get("Destination") == own]
    alone = bool(names) and all(map(_OWN.fullmatch, names))
    return fresh and (alone or not own)


def _volumes(inspected: Mapping[str, Any]) -> tuple[str, ...]:
    return tuple(f"{_VOLUME}{one['Name']}" for one in inspected.get("Mounts") or () if one.get("Name"))


def _joined(inspected: Mapping[str, Any]) -> tuple[str, ...]:
    """Whose network it is in."""
    _, joins, container = str((inspected.get("HostConfig") or {}).get("NetworkMode")).partition("container:")
    return (container,) if joins else ()
