"""What people ask the gate: status, stop, reset, start; answered within the gate's loop, which waits for nobody.

A stop is acknowledged when it is kept, which is the guard's part. Only if the guard does not answer, the gate keeps it
in the guard's file, so that the guard which starts next knows of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from skytether.guard.estop import EstopFile, clean
from skytether.guard.protocol import FIRST_ACT
from skytether.guard.requests import Reply

from ..rules.rules import Gate
from .heartbeat import Heartbeat

_GUARD_KEEPS_S = 0.3
"""After so long the gate keeps a stop itself."""
_KEPT_S = 1.3
"""A stop that is not kept after so long is acknowledged as such."""
_RESET_S = 2.0


class Control:
    """The requests.

    Args:
        gate: The rules.
        heartbeat: To the guard.
        keeper: Of the guard's file.
        status: What is answered.
        clock: `skytether.guard.clock.now`.
    """

    def __init__(
        self,
        gate: Gate,
        heartbeat: Heartbeat,
        keeper: EstopFile,
        status: Callable[[], Reply],
        clock: Callable[[], float],
    ) -> None:
        self.resets = False
        """A person wants the guard's emergency stop to end, and may."""
        self._gate = gate
        self._heartbeat = heartbeat
        self._keeper = keeper
        self._status = status
        self._clock = clock
        self._changes = 0
        self._reset_until = 0.0
        self._reset_of: int | None = None
        """The stop that the person who asked for the reset could know of; None: of the first that the guard tells."""

    def turn(self, now: float) -> None:
        """What the guard says about the emergency stop holds for the gate."""
        answer = self._heartbeat.answer
        if answer is None:
            return
        if self.resets and not answer.stopped:
            self.resets = False
            self._gate.reset(now)
        elif answer.stopped:
            self._gate.engage(answer.stopped)
            if self._reset_of is None:
                self._reset_of = answer.generation
            if answer.generation != self._reset_of:
                self.resets = False  # somebody has stopped the robot again since

    def handle(self, asked: Mapping[str, object]) -> Reply | Callable[[], Reply | None]:
        """A request; its answer, or what has it later."""
        what = asked["do"]
        if what == "status":
            return self._status()
        if what == "stop":
            return self._stop(clean(asked.get("reason")) or "somebody asked for it")
        if what == "reset":
            return self._reset(str(asked.get("only", "")))
        if what == "start":
            started, refused = self._gate.start(self._clock())
            return {"refused": refused} if refused else {**self._status(), "started": started}
        if what == "mode":
            refused = self._gate.set_modes(str(asked.get("modes", "")), self._clock())
            return {"refused": refused} if refused else self._status()
        return {"refused": f"there is no request {str(what)[:40]!r}; there are status, stop, reset, start and mode"}

    def _stop(self, reason: str) -> Callable[[], Reply | None]:
        self._gate.engage(reason)
        self.resets = False
        begun = self._clock()
        change = 0

        def kept() -> Reply | None:
            nonlocal change
            answer, waited = self._heartbeat.answer, self._clock() - begun
            known = answer is not None and answer.stopped not in ("", FIRST_ACT)
            if answer is not None and known and answer.kept and answer.at >= begun:
                return self._status()
            if waited < _GUARD_KEEPS_S:
                return None
            if not change:
                self._changes = change = self._changes + 1
                self._keeper.keep(change, self._gate.stopped)
            done, error = self._keeper.kept
            if done >= change and not error:
                return self._status()
            if error or waited > _KEPT_S:
                why = error or "the disk does not answer"
                return {**self._status(), "note": f"the stop is in effect, but could not be kept: {why}"}
            return None

        return kept

    def _reset(self, only: str) -> Reply | Callable[[], Reply | None]:
        now = self._clock()
        if only and self._gate.stopped != only:
            return {"refused": f"the robot is not stopped because '{only}', but: {self._gate.stopped or 'not at all'}"}
        if refused := self._gate.refuses_reset(now):
            return {"refused": refused}
        answer = self._heartbeat.answer
        if not self._gate.stopped and answer is not None and not answer.stopped:
            self._gate.reset(now)  # a joystick that was lost, and what sensors have learnt
            return self._status()
        self.resets, self._reset_until = True, now + _RESET_S
        self._reset_of = None if answer is None else answer.generation

        def done() -> Reply | None:
            if self.resets and self._clock() <= self._reset_until:
                return None
            if self.resets:
                self.resets = False
                return {"refused": "the guard does not answer, and only it can end the stop"}
            if self._gate.stopped:
                return {"refused": f"still stopped: {self._gate.stopped}"}
            return self._status()

        return done
