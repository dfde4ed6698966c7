"""Delay compensation: where the robot will be, and how fast, when the command that is being computed arrives.

A service sees a pose that is old, and its command acts later still. In between the robot obeys commands that were sent
before; they are known, so their effect is replayed from the pose seen to the moment of arrival. The bridge measures for
each message how long it takes; all times here are of the service's own clock.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import pairwise

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.service import param
from skytether_services.planar.geometry import Pose, advance

MAX_COMMANDS = 256
"""Remembered: more than eight seconds of commands at 30 Hz. Older ones have arrived, or never will."""
_STEP = 0.01
"""Of the robot's response [s]."""


class Compensation(StrEnum):
    """Which delay is made up for."""

    OFF = "off"
    FIXED = "fixed"
    MEASURED = "measured"


@dataclass(frozen=True)
class DelayParams:
    """How the state at a command's arrival is predicted."""

    compensation: Compensation = param(  # noqa: RUF009 - an enum is as immutable as a number
        Compensation.MEASURED,
        doc="off: plan from the pose as it was seen; fixed: as if every round trip took `fixed_delay`; "
        "measured: by the delay of each message",
    )
    fixed_delay: float = param(
        0.0, unit="s", ge=0, le=2, doc="from a pose to the arrival of the command that it led to"
    )
    max_delay: float = param(1.0, unit="s", gt=0, le=2, doc="never predict farther than this")
    lag: float = param(
        0.0, unit="s", ge=0, le=2, doc="time constant with which the wheels follow a command; 0: at once"
    )
    linear_acceleration: float = param(1.0, unit="m/s^2", gt=0, doc="with which the wheels follow at most")
    angular_acceleration: float = param(2.0, unit="rad/s^2", gt=0, doc="with which the robot's turning follows at most")


@dataclass(frozen=True, slots=True)
class State:
    """Of the robot at one moment.

    Attributes:
        pose: On the map.
        velocity: Measured.
        time: They are of this time, on the service's clock [s].
        velocity_age: But the velocity is older than the pose by this [s].
    """

    pose: Pose
    velocity: Velocity
    time: float
    velocity_age: float = 0.0


@dataclass(frozen=True, slots=True)
class _Sent:
    velocity: Velocity
    sent: float
    arrives: float


def respond(velocity: Velocity, command: Velocity, dt: float, params: DelayParams) -> Velocity:
    """Velocity after dt [s] of a command: a first-order lag, and no faster than the accelerations allow."""
    share = 1.0 - math.exp(-dt / params.lag) if params.lag > 0 else 1.0
    linear, angular = params.linear_acceleration * dt, params.angular_acceleration * dt
    return Velocity(
        velocity.linear + min(max((command.linear - velocity.linear) * share, -linear), linear),
        velocity.angular + min(max((command.angular - velocity.angular) * share, -angular), angular),
    )


def replay(state: State, commands: list[tuple[float, Velocity]], until: float, params: DelayParams) -> State:
    """Drive on through the commands.

    Args:
        state: To begin with.
        commands: Each with the time from which it acts [s], in order. The first acts from the beginning.
        until: The moment to predict [s]; before the state's own: the state as it is.
        params: How the robot follows.
    """
    pose, velocity, now = state.pose, state.velocity, state.time
    for (_, command), following in pairwise([*commands, (until, STANDSTILL)]):
        end = min(following[0], until)
        while end - now > 1e-9:
            dt = min(_STEP, end - now)
            after = respond(velocity, command, dt, params)
            pose = advance(pose, (velocity.linear + after.linear) / 2, (velocity.angular + after.angular) / 2, dt)
            velocity = after
            now += dt
    return State(pose, velocity, max(now, until)) if until > state.time else state


class PredictedState:
    """Remembers what was sent, and predicts with it."""

    def __init__(self, params: DelayParams) -> None:
        self._params = params
        self._sent: deque[_Sent] = deque(maxlen=MAX_COMMANDS)

    def sent(self, velocity: Velocity, now: float, delay: float) -> None:
        """A command was sent.

        Args:
            velocity: The command.
            now: When [s].
            delay: How long such a message takes at present, as the bridge measures it [s].
        """
        delay = min(max(delay, 0.0), self._params.max_delay) if math.isfinite(delay) else 0.0
        self._sent.append(_Sent(velocity, now, now + delay))

    def clear(self) -> None:
        """Forget all commands: the robot did not obey them (it stopped, or its fallback drove)."""
        self._sent.clear()

    def at_arrival(self, state: State, now: float, delay: float) -> State:
        """The robot's state when a command that is sent now arrives.

        Args:
            state: As it was seen; its time is when it was true, on this clock: arrival less the measured delay [s].
            now: [s].
            delay: How long a command takes at present [s].
        """
        params = self._params
        if params.compensation is Compensation.OFF or not math.isfinite(state.time):
            return state
        if params.compensation is Compensation.FIXED:
            # The sum alone matters: what was sent within the delay has not acted yet when the pose was true.
            begin = now - min(params.fixed_delay, params.max_delay)
            sent = [(entry.sent, entry.velocity) for entry in self._sent]
            return self._replayed(replace(state, time=begin), sent, now)
        delay = max(delay, 0.0) if math.isfinite(delay) else 0.0
        until = min(now + delay, state.time + params.max_delay)
        return self._replayed(state, self._arrivals(), until)

    def _replayed(self, state: State, arrivals: list[tuple[float, Velocity]], until: float) -> State:
        """Velocities are often measured less often than poses: first that one is made as new as the pose is."""
        if 0 < state.velocity_age <= self._params.max_delay:
            old = State(state.pose, state.velocity, state.time - state.velocity_age)
            newer = replay(old, _acting(arrivals, old.time, old.velocity), state.time, self._params)
            state = State(state.pose, newer.velocity, state.time)
        return replay(state, _acting(arrivals, state.time, state.velocity), until, self._params)

    def _arrivals(self) -> list[tuple[float, Velocity]]:
        """In order of arrival, without those that a newer one overtook: the robot drops them."""
        kept: list[tuple[float, Velocity]] = []
        earliest = math.inf
        for entry in reversed(self._sent):
            if entry.arrives <= earliest:
                earliest = entry.arrives
                kept.append((entry.arrives, entry.velocity))
        kept.reverse()
        return kept


def _acting(arrivals: list[tuple[float, Velocity]], begin: float, velocity: Velocity) -> list[tuple[float, Velocity]]:
    """Those that act from the beginning on; before the first one the robot keeps its velocity."""
    acting = [(begin, velocity)]
    for time, command in arrivals:
        if time <= begin:
            acting = [(begin, command)]
        else:
            acting.append((time, command))
    return acting
