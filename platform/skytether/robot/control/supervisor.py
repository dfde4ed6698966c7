"""The last gate before the wheels (Mello, thesis, section 5.1: Velocity Supervisor). Pure: time is an argument.

A command passes twice. `admit` looks at it once, when it arrives: finite, in sequence, fresh. `step` runs at every tick
of the control loop, takes what was last admitted from the source in charge, looks at its age again, and gives the
wheels a velocity within the limits and within reach of the previous one. Whatever comes in, `step` gives a velocity
that is safe; without a valid command it brakes to a standstill and stays there.

No message, parameter or answer of the orchestrator changes a limit: they come from the robot's own configuration.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import lru_cache
from math import inf, isfinite, isnan, nan
from typing import ClassVar

from pydantic import ConfigDict

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.control.numbers import check_positive

from .command import Command, Source


class Objection(StrEnum):
    """What the supervisor found wrong; bounded, for counters."""

    NOT_FINITE = "not_finite"
    """A number of the command is NaN or infinite."""
    UNUSED_AXES = "unused_axes"
    """It wants to move along an axis that these wheels do not have; to follow a part of it would lead elsewhere."""
    SEQUENCE = "sequence"
    """Not newer than one that was admitted in the same or a later handshake."""
    STALE = "stale"
    """Made from information that may be older than allowed."""
    GAP = "gap"
    """The last command arrived too long ago."""
    FUTURE = "future"
    """Sent or arrived later than now, beyond the clocks' error."""
    CLOCK = "clock"
    """The peer's clock is not known, or the robot's own did not advance."""
    NO_COMMAND = "no_command"
    """The source in charge has given none yet, or nobody is in charge."""
    LINEAR_LIMIT = "linear_limit"
    ANGULAR_LIMIT = "angular_limit"
    LINEAR_ACCELERATION = "linear_acceleration"
    ANGULAR_ACCELERATION = "angular_acceleration"


DEFAULT_GAP_S = 0.15
_BLIND_M = 0.1
"""How far the robot may go on a command that has no successor, where nothing else is configured."""
_MOST_SILENCE_S = 0.5
"""And for how long, however slow it is: a person sees nothing happen."""


@dataclass(frozen=True, slots=True)
class VelocityLimits:
    """What the robot's wheels may do, whoever drives. The defaults are the walker's (thesis section 2.5.1).

    Attributes:
        linear_max: Fastest forward [m/s].
        linear_min: Fastest backward, 0 or negative [m/s]; 0: never backwards.
        angular_max: Fastest to either side [rad/s].
        linear_acceleration: Of ordinary changes, both ways [m/s^2].
        angular_acceleration: Of ordinary changes, both ways [rad/s^2].
        linear_braking: When no valid command is there [m/s^2].
        angular_braking: When no valid command is there [rad/s^2].
        max_gap_s: Longest time that a command is repeated when no newer one arrives [s]; see also `silence_s`.
        max_local_age_s: Oldest readings that a command of the robot's own fallback may be made from [s].
        clock_tolerance_s: How far in the future a time may lie: readers of one clock in several threads [s].
        period_s: Of the control loop; used to brake with when the clock fails [s].
        max_step_s: Longest time that one step counts for, so that a late one does not jump [s].
        watchdog_s: The wheels stop by themselves when they hear nothing for this long: a control loop that stood for
            longer begins again from standstill, with new commands and readings only [s].
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid", allow_inf_nan=False)

    linear_max: float = 0.25
    linear_min: float = 0.0
    angular_max: float = 0.5
    linear_acceleration: float = 1.0
    angular_acceleration: float = 2.0
    linear_braking: float = 2.0
    angular_braking: float = 4.0
    max_gap_s: float = DEFAULT_GAP_S
    max_local_age_s: float = 0.1
    clock_tolerance_s: float = 0.01
    period_s: float = 0.01
    max_step_s: float = 0.05
    watchdog_s: float = 0.1

    @property
    def silence_s(self) -> float:
        """Longest time that a command from the cloud may be repeated, however irregular the cloud is [s].

        It is `max_gap_s`, if that is another than the default; else the time in which the robot goes 0.1 m at its
        fastest, between 0.15 and 0.5 s. How long it is in fact follows from how regularly commands come (`accrual`).
        """
        if self.max_gap_s != DEFAULT_GAP_S:
            return self.max_gap_s
        return min(max(_BLIND_M / max(self.linear_max, -self.linear_min), DEFAULT_GAP_S), _MOST_SILENCE_S)

    def __post_init__(self) -> None:
        """Refuse limits that would not limit.

        Raises:
            ValueError: A field is out of its range; the text names it.
        """
        if not -inf < self.linear_min <= 0:
            raise ValueError(f"limits: linear_min must be 0 or negative, not {self.linear_min}")
        check_positive(self, "limits", (name for name in self.__slots__ if name != "linear_min"))
        if self.linear_braking < self.linear_acceleration or self.angular_braking < self.angular_acceleration:
            raise ValueError("limits: braking must not be slower than ordinary acceleration")


@lru_cache(maxsize=64)
def with_gap(limits: VelocityLimits, max_gap_s: float) -> VelocityLimits:
    """The same limits with another `VelocityLimits.max_gap_s`; asked several times in each turn of a loop."""
    return replace(limits, max_gap_s=max_gap_s)


@dataclass(frozen=True, slots=True)
class Supervised:
    """What the supervisor remembers from tick to tick.

    Attributes:
        velocity: What the wheels were last told.
        now: When they were told; None before the first step.
        held: The command last admitted from each source.
        since: Commands made before that time are not followed.
    """

    velocity: Velocity = STANDSTILL
    now: float | None = None
    held: dict[str, Command] = field(default_factory=dict)
    since: float = -inf


def admit(
    limits: VelocityLimits, state: Supervised, command: Command, max_age_s: float, now: float
) -> tuple[Supervised, Objection | None]:
    """Look at a command that just arrived; hold it if it is good.

    Args:
        limits: The robot's.
        state: What is remembered.
        command: The arrival.
        max_age_s: Oldest information that the source may act on [s]; see `max_age`.
        now: Monotonic seconds.

    Returns:
        The new state, and what was wrong if the command was not admitted (the state is then unchanged).
    """
    objection = _objection_at_arrival(limits, state, command, max_age_s, now)
    if objection:
        return state, objection
    return replace(state, held={**state.held, command.source: command}), None


def step(
    limits: VelocityLimits, state: Supervised, charge: str, max_age_s: float, now: float
) -> tuple[Supervised, tuple[Objection, ...]]:
    """Decide what the wheels are told now: the ``velocity`` of the new state.

    Args:
        limits: The robot's.
        state: What is remembered.
        charge: Who is in charge, as the arbiter says; commands of others are not looked at.
        max_age_s: Oldest information that the source in charge may act on [s].
        now: Monotonic seconds.

    Returns:
        The new state, and everything that was objected to.
    """
    dt = elapsed(limits, state, now)
    state = _advance(state, now)
    command = state.held.get(charge)
    objection = _objection_while_held(limits, command, max_age_s, now)
    objections: tuple[Objection, ...]
    if command is None or objection is not None:
        velocity, objections = _brake(limits, state.velocity, dt), (objection or Objection.NO_COMMAND,)
    else:
        velocity, objections = _follow(limits, state.velocity, command, dt)
    return replace(state, velocity=velocity), objections


def wants_standstill(limits: VelocityLimits, state: Supervised, charge: str, max_age_s: float, now: float) -> bool:
    """Whether a command is followed, and it is one to stand. Arguments as those of `step`."""
    command = state.held.get(charge)
    if command is None or _objection_while_held(limits, command, max_age_s, now) is not None:
        return False
    return max(abs(command.linear), abs(command.angular)) <= _STANDS


def begin_anew(state: Supervised, now: float) -> Supervised:
    """The loop stood still, and so do the wheels: nothing that is held is followed, nor what was sent before now.

    The sequence is kept: a command that came before does not come again.
    """
    held = {source: replace(command, received_at=-inf) for source, command in state.held.items()}
    return Supervised(held=held, since=now)


def max_age(limits: VelocityLimits, source: str, max_rtt_s: float | None) -> float:
    """Oldest information that a source may act on [s].

    From the cloud: what a service needs of the round trip, and the time that a command may be repeated. The clock
    offset's error is at most half a round trip, so the bound of a command's age at its arrival is at most one round
    trip: a link that the service's manifest allows is never called stale.
    """
    if source == Source.CLOUD:
        return (DEFAULT_MAX_RTT_S if max_rtt_s is None else max_rtt_s) + limits.max_gap_s
    return limits.max_local_age_s


DEFAULT_MAX_RTT_S = 1.0
"""For services that state no need: no robot is driven by what is older."""


_STANDS = 1e-3
"""A speed that counts as a standstill: the rest of a ramp, a stick that is not quite in its middle [m/s, rad/s]."""
_UNUSED_MOST = 1e-3
"""A speed along an axis that the wheels do not have which is some planner's rounding [m/s, rad/s]."""


def elapsed(limits: VelocityLimits, state: Supervised, now: float) -> float:
    """Time [s] that the step at ``now`` counts for: since the last one, or a period when the clock does not say."""
    if state.now is not None and isfinite(now) and now > state.now:
        return min(now - state.now, limits.max_step_s)
    return limits.period_s


def _advance(state: Supervised, now: float) -> Supervised:
    """Take the time in. When the clock did not advance, nothing that is held can be judged by it any more."""
    if state.now is None:
        return replace(state, now=now if isfinite(now) else None)
    if isfinite(now) and now > state.now:
        return replace(state, now=now)
    held = {source: replace(command, received_at=nan) for source, command in state.held.items()}
    return replace(state, now=now if isfinite(now) else state.now, held=held)


def _objection_at_arrival(
    limits: VelocityLimits, state: Supervised, command: Command, max_age_s: float, now: float
) -> Objection | None:
    if not (isfinite(command.linear) and isfinite(command.angular) and isfinite(command.unused)):
        return Objection.NOT_FINITE
    if abs(command.unused) > _UNUSED_MOST:
        return Objection.UNUSED_AXES
    held = state.held.get(command.source)
    if held is not None and (command.epoch, command.sequence) <= (held.epoch, held.sequence):
        return Objection.SEQUENCE
    objection = _objection_while_held(limits, command, max_age_s, now)
    if objection is None and not command.sent_at - command.sent_at_error >= state.since:
        return Objection.STALE
    return objection


def _objection_while_held(
    limits: VelocityLimits, command: Command | None, max_age_s: float, now: float
) -> Objection | None:
    """Comparisons are written so that a NaN anywhere objects."""
    if command is None:
        return Objection.NO_COMMAND
    if not 0 <= command.sent_at_error < inf:
        return Objection.CLOCK
    gap = now - command.received_at
    if isnan(gap):
        return Objection.CLOCK
    age = now - command.sent_at
    if not (gap >= -limits.clock_tolerance_s and age >= -limits.clock_tolerance_s - command.sent_at_error):
        return Objection.FUTURE
    if not gap <= limits.max_gap_s:
        return Objection.GAP
    if not age + command.sent_at_error <= max_age_s:
        return Objection.STALE
    return None


def _brake(limits: VelocityLimits, velocity: Velocity, dt: float) -> Velocity:
    return Velocity(
        _approach(velocity.linear, 0.0, limits.linear_braking * dt),
        _approach(velocity.angular, 0.0, limits.angular_braking * dt),
    )


def _follow(
    limits: VelocityLimits, velocity: Velocity, command: Command, dt: float
) -> tuple[Velocity, tuple[Objection, ...]]:
    linear = min(max(command.linear, limits.linear_min), limits.linear_max)
    angular = min(max(command.angular, -limits.angular_max), limits.angular_max)
    reached = Velocity(
        _approach(velocity.linear, linear, limits.linear_acceleration * dt),
        _approach(velocity.angular, angular, limits.angular_acceleration * dt),
    )
    objections = []
    if linear != command.linear:
        objections.append(Objection.LINEAR_LIMIT)
    if angular != command.angular:
        objections.append(Objection.ANGULAR_LIMIT)
    if reached.linear != linear:
        objections.append(Objection.LINEAR_ACCELERATION)
    if reached.angular != angular:
        objections.append(Objection.ANGULAR_ACCELERATION)
    return reached, tuple(objections)


def _approach(value: float, target: float, most: float) -> float:
    """Go from ``value`` towards ``target``, at most by ``most``."""
    if abs(target - value) <= most:
        return target
    return value + most if target > value else value - most
