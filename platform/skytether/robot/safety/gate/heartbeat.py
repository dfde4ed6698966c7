"""The gate's end of the socket to the guard: beats there, answers back, and the wheels when nobody else tells them.

What the wheels were really told last is on the board. When the guard, or on a graph its writer, puts nothing there any
more, because it is gone, frozen or not heard, the gate stops the wheels itself, from there.
"""

from __future__ import annotations

import socket
from collections.abc import Callable
from contextlib import suppress

from skytether.guard.board import Board, Role
from skytether.guard.kinematics import Bounds
from skytether.guard.protocol import LARGEST, Answer, Beat, LastCommand, pack_beat, pack_note, unpack_answer
from skytether.guard.teller import Teller
from skytether.guard.velocity import STANDSTILL, Velocity
from skytether.guard.watch import Watch

from ...graphs.gate_io import Wheels

_ROUNDING = 1e-9
_PACKETS = 64
"""Answers taken in one turn; there is one for each beat."""


class Heartbeat:
    """What the gate knows of the guard, and of what the wheels were told.

    Args:
        guard: The socket; whole packets, never waits.
        wheels: The gate's own way to them.
        bounds: Of the wheels.
        period_s: Of the gate's loop [s].
        patience_s: With the guard [s].
        board: What the wheels were told.
        trouble: Told a kind, a sentence and the time.
        clock: `skytether.guard.clock.now`; replaced by tests only.
    """

    def __init__(
        self,
        guard: socket.socket,
        wheels: Wheels,
        bounds: Bounds,
        period_s: float,
        patience_s: float,
        board: Board,
        trouble: Callable[[str, str, float], object],
        clock: Callable[[], float],
    ) -> None:
        self.gone = False
        """The guard has ended."""
        self.answer: Answer | None = None
        """Its newest."""
        self._guard = guard
        self._watch = Watch(bounds, period_s, patience_s)
        self._period_s = period_s
        self._patience_s = patience_s
        self._teller = Teller(wheels, self._watch, board, Role.SECOND, period_s, clock)
        self._clock = clock
        self._trouble = trouble

    def receive(self) -> None:
        """Take in what the guard answers, and what the wheels were told."""
        self._teller.refresh(self._clock())
        for _ in range(_PACKETS):
            try:
                data = self._guard.recv(LARGEST)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self.gone = True
                return
            answer = unpack_answer(data)
            if answer is not None:
                self.answer = answer

    def told(self, now: float) -> LastCommand:
        """What the wheels were told last; after a stall, a standstill."""
        told = self._watch.told
        return told if now - told.at <= self._patience_s else LastCommand(STANDSTILL, now)

    def differs(self, said: Velocity, now: float) -> LastCommand | None:
        """What the gate is to go on from instead of what it said; None: that is as good. See `differs`."""
        return differs(self._watch.told, said, now, self._patience_s, self._period_s)

    def send(self, velocity: Velocity, stopped: str, reset: bool, now: float) -> Velocity:
        """Tell the guard what is wanted; the wheels, if nobody else tells them anything.

        Args:
            velocity: Wanted.
            stopped: The gate's emergency stop; empty: there is none.
            reset: A person wants the guard's emergency stop to end, and may.
            now: [s]

        Returns:
            What the gate has said so, to either.
        """
        if self._speak(now):
            self._trouble("guard", "nobody else tells the wheels anything; the gate stops them itself", now)
            velocity = self.told(now).velocity
        generation = self.answer.generation if self.answer is not None else 0
        try:
            self._guard.send(pack_beat(Beat(now, velocity, generation, reset, stopped)))
        except BlockingIOError:
            pass
        except OSError:
            self.gone = True
        return velocity

    def stop_wheels(self, now: float) -> Velocity:
        """Brake the wheels by the gate's own way, one step, unless somebody else tells them. What they were told."""
        self._speak(now)
        return self.told(now).velocity

    def _speak(self, now: float) -> bool:
        """Tell the wheels to stop, if it is the gate's turn."""
        try:
            told = self._teller.write_velocity(now)
        except Exception as error:  # tried again at the next turn
            self._trouble("wheels", f"the wheels cannot be told to stand: {error}", now)
            told = True
        if self._teller.ended:
            self._trouble("ended", self._teller.ended, now)
        return told

    def note(self, sentence: str) -> None:
        """Something for the guard's event record."""
        with suppress(OSError):
            self._guard.send(pack_note(sentence))


def differs(told: LastCommand, said: Velocity, now: float, patience_s: float, period_s: float) -> LastCommand | None:
    """What the wheels were told if that is nearer to standstill than what the gate said; None: it is not. Pure.

    What is farther from standstill is the guard's to brake: a gate that went back to it would brake less.

    Args:
        told: What the wheels were told last.
        said: What the gate said last.
        now: [s]
        patience_s: Longest gap that is no standstill [s].
        period_s: Of the gate's loop [s].
    """
    if not now - told.at <= patience_s:
        return LastCommand(STANDSTILL, now - period_s)
    if any(_nearer(t, s) for t, s in zip(told.velocity, said, strict=True)):
        return LastCommand(told.velocity, min(told.at, now - period_s / 100))
    return None


def _nearer(told: float, said: float) -> bool:
    return told * said < 0 or abs(told) < abs(said) - _ROUNDING
