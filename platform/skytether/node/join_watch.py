"""While an engine may start containers that join another one's network, somebody looks after both.

It does so in no thread: where the machine has no numbers for processes left, none begins.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Collection
from typing import Self

from . import shims
from .asking import begun, killed, state_of
from .cgroups import Cgroups
from .machine import ask_soon

log = logging.getLogger(__name__)

_LOOK_S = 0.02
"""Between looks whether the one whose network is joined has ended."""
_LONG_S, PATIENCE_S = 10.0, 3.0
"""How long a start usually takes at most, and an engine to say what a container is."""
_MOMENT_S = 1.0
"""For a shim to do what it was asked."""
_MOST_SILENT = 3
"""Times that it says nothing, one after the other, until those that join are ended; after one more nobody waits."""


class Life:
    """Of a container, from now on until it ends: it may be started again after that, and is another one then.

    An engine may say for seconds of one that has ended that it runs. So the kernel is asked, too: its first process is
    its last, and has its number so long.
    """

    def __init__(self, engine: str, container: str) -> None:
        """``engine``: path of its socket. `begin` comes next."""
        self._engine, self._container = engine, container
        self._cgroups: Cgroups | None = None
        self._told: list[object] | None = None
        self._ended = False
        self.went_on = False
        """Whether it had not ended at first, by the kernel's word."""

    async def begin(self, **how: float) -> Self:
        """Look at it first; ``how``: as `state_of`."""
        with contextlib.suppress(OSError):
            self._cgroups = Cgroups()
        self._told = await self._ask(**how)
        self.went_on = not self.has_ended()
        return self

    def has_ended(self) -> bool:
        """By the kernel's word; so it is, too, where the kernel does not show it."""
        self._ended = self._ended or self._cgroups is None or not self._cgroups.go_on(self._container)
        return self._ended

    async def goes_on(self) -> bool:
        """Whether it has not ended, as far as is known."""
        told = await self._ask()  # first: what the kernel says after that is the newer word
        return self.is_known() and told in (self._told, None) and not self.has_ended()

    def is_known(self) -> bool:
        """Whether it was there at first."""
        return self._told is not None and self._told[0] is True

    def first(self) -> object:
        """The number of its first process, as the engine says it."""
        return self._told[1] if self._told else None

    async def _ask(self, **how: float) -> list[object] | None:
        state = await state_of(self._engine, self._container, **how)
        return None if state is None else [state.get(key) for key in ("Running", "Pid", "StartedAt")]


class JoinWatch:
    """Looks after a container whose network others join, and after these; until `close`.

    - Once it has ended, those are ended as soon as they have processes: mostly before their programs begin.
    - Where somebody else asks an engine to end it, the engine waits for its shim, and says nothing of it; and a start
      that has to ask for it waits, too. So its shim goes on then for a moment, unless no start of theirs needs that
      any more: its number stays taken until that is over. If that takes long, who joins is ended; and nobody is kept
      waiting for good.

    Args:
        engine: Path of its socket.
        joined: That container.
        joining: Those that an engine may start just now.
        life: Of that container, since before their starts.
        first_look_s: Until the engine is first asked whether it waits [s]; None: as long as a start usually takes.
    """

    def __init__(
        self, engine: str, joined: str, joining: Collection[str], life: Life, first_look_s: float | None = None
    ) -> None:
        self._engine, self._joined, self._joining, self._life = engine, joined, set(joining), life
        there = _with_processes(self._joining)
        self._new = self._joining - there
        """Those whose processes are of a start that goes on since."""
        self._silent = 0
        self._killing: dict[str, asyncio.Task[bool]] = {}
        self._tasks = (begun(self._watch()), begun(self._let_end(_LONG_S if first_look_s is None else first_look_s)))

    def has_joined(self, container: str) -> None:
        """It is not looked after any more."""
        self._joining.discard(container)
        self._new.discard(container)

    def close(self) -> None:
        """Look no more."""
        for task in self._tasks:
            task.cancel()

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(_LOOK_S)
            if self._joining and self._life.went_on and self._life.has_ended():
                for one in _end_processes(self._joining):  # of another user's, the engine does it when it has started
                    if one not in self._killing or self._killing[one].done():
                        self._killing[one] = begun(killed(self._engine, one))

    async def _let_end(self, first_look_s: float) -> None:
        await asyncio.sleep(first_look_s)
        while True:
            self._silent = self._silent + 1 if await self._is_silent() else 0
            if self._silent >= _MOST_SILENT:
                _end_processes(self._new)
            if self._silent:
                with contextlib.suppress(OSError):
                    await self._let_shim_go_on()
            await asyncio.sleep(_LONG_S)

    async def _let_shim_go_on(self) -> None:
        """If it may; for a moment only, for the engine may just have much to do for that container."""
        last = self._silent > _MOST_SILENT
        if last or not shims.is_any(self._joining):
            stopped = shims.resume(self._joined)
            await asyncio.sleep(_MOMENT_S)
            if stopped and not last and not self._life.has_ended():
                shims.stop(self._joined, self._life.first())

    async def _is_silent(self) -> bool:
        """Whether the engine says nothing of that one, though it is there."""
        try:
            await ask_soon(self._engine, f"/containers/{self._joined}/json", patience=PATIENCE_S)
        except TimeoutError:
            return True
        except (OSError, ValueError):
            return False
        return False


def _with_processes(containers: Collection[str]) -> set[str]:
    with contextlib.suppress(OSError):
        cgroups = Cgroups()
        return {one for one in containers if cgroups.go_on(one)}
    return set(containers)


def _end_processes(containers: Collection[str]) -> list[str]:
    """End those that this program may end; says which containers had any."""
    with contextlib.suppress(OSError):
        cgroups = Cgroups()
        found = [one for one in containers if cgroups.go_on(one)]
        for one in found:
            cgroups.end(one)
        return found
    return []
