"""The gate's end of the socket to the guard: beats there, answers back, and the wheels when the guard is gone.

The guard answers every beat with what the wheels were really told last. A guard that does not, because it is gone,
frozen or has lost its writer, makes the gate stop the wheels itself, ramped from there.
"""

from __future__ import annotations

import socket
from collections.abc import Callable
from contextlib import suppress

from skytether.guard.kinematics import Bounds
from skytether.guard.protocol import LARGEST, Answer, Beat, Told, pack_beat, pack_note, unpack_answer
from skytether.guard.velocity import STANDSTILL, Velocity
from skytether.guard.watch import Watch

from .hardware import Wheels

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
        trouble: Told a kind, a sentence and the time.
    """

    def __init__(
        self,
        guard: socket.socket,
        wheels: Wheels,
        bounds: Bounds,
        period_s: float,
        patience_s: float,
        trouble: Callable[[str, str, float], object],
    ) -> None:
        self.gone = False
        """The guard has ended."""
        self.answer: Answer | None = None
        """Its newest."""
        self._guard = guard
        self._wheels = wheels
        self._watch = Watch(bounds, period_s, patience_s)
        self._period_s = period_s
        self._patience_s = patience_s
        # The gate begins so early that the wheels are not without a word until they stop by themselves: they are
        # without one since the beat before the first that was not answered, and a turn may come late.
        self._silence_s = max(patience_s - 3.5 * period_s, period_s)
        self._trouble = trouble
        self._wrote = Told()
        self._unanswered: float | None = None

    def hear(self) -> None:
        """Take the guard's answers in."""
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
                self.answer, self._unanswered = answer, None
                self._watch.learn(answer.told)

    def told(self, now: float) -> Told:
        """What the wheels were told last; after a stall, a standstill."""
        told = self._watch.told
        return told if now - told.at <= self._patience_s else Told(STANDSTILL, now)

    def differs(self, said: Velocity, now: float) -> Told | None:
        """What the gate is to go on from instead of what it said; None: that is as good. See `differs`."""
        return differs(self._watch.told, said, now, self._patience_s, self._period_s)

    def say(self, velocity: Velocity, stopped: str, reset: bool, now: float) -> Velocity:
        """Tell the guard what is wanted; the wheels too, if it has gone silent.

        Args:
            velocity: Wanted.
            stopped: The gate's emergency stop; empty: there is none.
            reset: A person wants the guard's emergency stop to end, and may.
            now: [s]

        Returns:
            What the gate has said so, to either.
        """
        silent = self._unanswered is not None and now - self._unanswered > self._silence_s
        if self.gone or silent or (self.answer is not None and self.answer.take):
            if not self.gone:
                self._trouble("guard", "the guard does not answer; the gate stops the wheels itself", now)
            velocity = self.stop_wheels(now)
        generation = self.answer.generation if self.answer is not None else 0
        self._unanswered = now if self._unanswered is None else self._unanswered
        try:
            self._guard.send(pack_beat(Beat(now, velocity, self._wrote, generation, reset, stopped)))
        except BlockingIOError:
            pass
        except OSError:
            self.gone = True
        return velocity

    def stop_wheels(self, now: float) -> Velocity:
        """Brake the wheels by the gate's own way, one step."""
        velocity, _ = self._watch.want(now)
        try:
            self._wheels.write(velocity)
            self._watch.wrote(velocity, now)
            self._wrote = Told(velocity, now)
        except Exception as error:  # tried again at the next turn
            self._trouble("wheels", f"the wheels cannot be told to stand: {error}", now)
        return velocity

    def note(self, sentence: str) -> None:
        """Something for the guard's event record."""
        with suppress(OSError):
            self._guard.send(pack_note(sentence))


def differs(told: Told, said: Velocity, now: float, patience_s: float, period_s: float) -> Told | None:
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
        return Told(STANDSTILL, now - period_s)
    if any(_nearer(t, s) for t, s in zip(told.velocity, said, strict=True)):
        return Told(told.velocity, min(told.at, now - period_s / 100))
    return None


def _nearer(told: float, said: float) -> bool:
    return told * said < 0 or abs(told) < abs(said) - _ROUNDING
