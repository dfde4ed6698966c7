"""What the wheels received, held against what is promised. Pure: a record goes in, violations come out.

Wheels obey what came last, and stop by themselves after `Wheels.silence_s` without a word, as motor drives must. So
a robot of which nobody speaks stands, and whoever speaks to it again finds it standing.

Velocities may change by limit * time. The time is known to within `Wheels.jitter_s`: a process looks at its clock,
decides, and sends; the kernel stamps what it sends, and in between the process may lose the processor. The
tolerance is the same for every stretch of up to `_STRETCH_S`, not for every message, so that it cannot add up.

On a graph nobody knows when a message was sent, only when this process took it, and a process that was held up takes
many at once: they were sent at some time since it looked before (`SentVelocity.earliest`). What is possible by some of
these times is no violation: it would be one of whoever held up the judge.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf, isfinite
from typing import NamedTuple

from skytether.guard.velocity import STANDSTILL, Velocity
from skytether.robot.control.supervisor import VelocityLimits

_STRETCH_S = 0.5
"""Longest stretch over which a change of velocity is looked at: from full speed to standstill and more."""
_ROUNDING = 1e-6


@dataclass(frozen=True, slots=True)
class SentVelocity:
    """One velocity that the wheels received.

    Attributes:
        at: When it was sent [s].
        velocity: In the base frame [m/s, rad/s].
        sender: Process that sent it; 0: not known.
        earliest: It was sent at this time or later, until ``at`` [s]; None: at that very moment.
    """

    at: float
    velocity: Velocity
    sender: int = 0
    earliest: float | None = None

    @property
    def since(self) -> float:
        """When it was sent, at the earliest [s]."""
        return self.at if self.earliest is None else self.earliest


@dataclass(frozen=True, slots=True)
class Demand:
    """What the wheels have to do for a while.

    Attributes:
        since: When its cause happened [s].
        within_s: Time that it may take.
        until: End of it [s].
        why: In words, for the violation.
        speed: Still allowed, forward or backward [m/s]; 0: standstill, turns included.
    """

    since: float
    within_s: float
    until: float
    why: str
    speed: float = 0.0


@dataclass(frozen=True, slots=True)
class Wheels:
    """What holds always.

    Attributes:
        limits: Of velocity and acceleration.
        silence_s: After so long without a word the wheels stop by themselves.
        jitter_s: How well the time of a message is known, and the time between two.
    """

    limits: VelocityLimits
    silence_s: float
    jitter_s: float


@dataclass(frozen=True, slots=True)
class Violation:
    """A promise that was not kept.

    Attributes:
        at: When it was seen first [s].
        kind: ``number``, ``velocity``, ``acceleration``, ``standstill`` or ``motion``.
        text: What happened.
        times: How often, in the same stretch.
    """

    at: float
    kind: str
    text: str
    times: int = 1


@dataclass(frozen=True, slots=True)
class Finding:
    """What a record shows.

    Attributes:
        violations: In order of time.
        velocity_max: Fastest, forward or backward [m/s].
        acceleration_max: Largest change of the forward velocity by its time (`Wheels.jitter_s` added), speeding
            up or braking [m/s^2].
        standstill: Of the demand of standstill with the least time to spare: how long it took, and what was promised
            [s]; None: there was none.
    """

    violations: tuple[Violation, ...]
    velocity_max: float
    acceleration_max: float
    standstill: tuple[float, float] | None


def check(record: Sequence[SentVelocity], demands: Iterable[Demand], wheels: Wheels) -> Finding:
    """Hold a record against everything that is promised.

    Args:
        record: Of the wheels, in order of time. The first entry is where they start from.
        demands: What was demanded meanwhile.
        wheels: What holds always.
    """
    violations = _numbers(record, wheels)
    record = [told for told in record if _is_finite(told.velocity)]
    violations += _speeds(record, wheels)
    changes, acceleration = _changes(record, wheels)
    violations += changes
    motions = _motions(record, wheels)
    standstills: list[tuple[float, float]] = []
    for demand in demands:
        if demand.speed > 0:
            violations += _slower(record, demand)
            continue
        found, took = _stands(motions, demand)
        violations += found
        if demand.within_s > 0:
            standstills.append((took, demand.within_s))
    return Finding(
        violations=tuple(sorted(violations, key=lambda violation: violation.at)),
        velocity_max=max((abs(told.velocity.linear) for told in record), default=0.0),
        acceleration_max=acceleration,
        standstill=tightest(standstills),
    )


def tightest(standstills: Iterable[tuple[float, float]]) -> tuple[float, float] | None:
    """Of times to standstill, each with what was promised, the one with the least to spare; None: there is none."""
    return max(standstills, key=lambda both: both[0] - both[1], default=None)


def _is_finite(velocity: Velocity) -> bool:
    return isfinite(velocity.linear) and isfinite(velocity.angular)


def _numbers(record: Sequence[SentVelocity], wheels: Wheels) -> list[Violation]:
    bad = [told for told in record if not _is_finite(told.velocity)]
    return _merge([(told.at, f"the wheels were told {tuple(told.velocity)}") for told in bad], "number", wheels)


def _speeds(record: Sequence[SentVelocity], wheels: Wheels) -> list[Violation]:
    limits = wheels.limits
    return _merge(
        [
            (told.at, f"the wheels were told {told.velocity.linear:.3f} m/s, {told.velocity.angular:.3f} rad/s")
            for told in record
            if not limits.linear_min - _ROUNDING <= told.velocity.linear <= limits.linear_max + _ROUNDING
            or abs(told.velocity.angular) > limits.angular_max + _ROUNDING
        ],
        "velocity",
        wheels,
    )


def _changes(record: Sequence[SentVelocity], wheels: Wheels) -> tuple[list[Violation], float]:
    """Every pair within a stretch: whether the later velocity could be reached from the earlier one."""
    found: list[tuple[float, str]] = []
    most = 0.0
    for i, after in enumerate(record):
        # Where nobody knows whether the wheels had stopped by themselves, either is right.
        excess, text, acceleration = min(_excess(before, after, wheels) for before in _before(record, i, wheels))
        most = max(most, acceleration)
        if excess > _ROUNDING:
            found.append((after.at, text))
    return _merge(found, "acceleration", wheels), most


def _excess(before: Sequence[SentVelocity], after: SentVelocity, wheels: Wheels) -> tuple[float, str, float]:
    """By how much time [s] a velocity comes too early, after which one, and the largest change by its time [m/s^2]."""
    limits, jitter = wheels.limits, wheels.jitter_s
    worst, text, most = 0.0, "", 0.0
    for told in before:
        dt = max(0.0, after.at - told.since) + jitter
        linear, angular = told.velocity
        most = max(most, abs(after.velocity.linear - linear) / dt)
        needed = max(
            _needed(linear, after.velocity.linear, limits.linear_acceleration, limits.linear_braking),
            _needed(angular, after.velocity.angular, limits.angular_acceleration, limits.angular_braking),
        )
        if needed - dt > worst:
            worst = needed - dt
            text = (
                f"from {_words(told.velocity)} to {_words(after.velocity)} in {1e3 * (dt - jitter):.0f} ms, which takes"
                f" {1e3 * needed:.0f} ms"
            )
    return worst, text, most


def _before(record: Sequence[SentVelocity], i: int, wheels: Wheels) -> list[list[SentVelocity]]:
    """What the velocity at ``i`` is compared with: what was told before, back to a standstill by silence.

    A gap on the edge of silence leaves two possibilities: the wheels had stopped, or just not yet.
    """
    now, later = record[i].at, record[i]
    possible: list[list[SentVelocity]] = []
    found: list[SentVelocity] = []
    for told in (record[j] for j in range(i - 1, -1, -1)):
        stopped = [*found, SentVelocity(later.at, STANDSTILL, earliest=later.since)]
        if later.since - told.at > wheels.silence_s + wheels.jitter_s:
            return [*possible, stopped]
        if later.at - told.since > wheels.silence_s - wheels.jitter_s:
            possible.append(stopped)
        if now - told.at > _STRETCH_S:
            break
        found.append(told)
        later = told
    return [*possible, found]


def _needed(before: float, after: float, acceleration: float, braking: float) -> float:
    """Least time [s] from one velocity to another."""
    if before < 0:
        before, after = -before, -after
    if after >= before:
        return (after - before) / acceleration
    if after >= 0:
        return (before - after) / braking
    return before / braking - after / acceleration


class _Motion(NamedTuple):
    """When the wheels turned."""

    start: float
    """At the earliest [s]."""
    end: float
    velocity: Velocity
    """At first."""
    surely: float
    """When they turned for sure [s]."""


def _motions(record: Sequence[SentVelocity], wheels: Wheels) -> list[_Motion]:
    """Neighbours that touch are one."""
    found: list[_Motion] = []
    for i, told in enumerate(record):
        if told.velocity == STANDSTILL:
            continue
        end = told.since + wheels.silence_s
        if i + 1 < len(record):
            end = min(end, record[i + 1].since)
        if found and told.since <= found[-1].end:
            found[-1] = found[-1]._replace(end=end)
        else:
            found.append(_Motion(told.since, end, told.velocity, told.at))
    return found


def _stands(motions: Sequence[_Motion], demand: Demand) -> tuple[list[Violation], float]:
    """Whether the robot stands in time and stays so; and how long it took [s]."""
    by, took = demand.since + demand.within_s, 0.0
    found = []
    for start, end, velocity, surely in motions:
        if end <= demand.since or surely >= demand.until:  # what may have begun after it is held against nobody
            continue
        end = min(end, demand.until)
        if start < by:
            took = max(took, end - demand.since)
            if end > by + _ROUNDING:
                text = f"{demand.why}: stands after {end - demand.since:.3f} s, {demand.within_s:.3f} s were promised"
                found.append(Violation(by, "standstill", text))
        else:
            text = (
                f"{demand.why}: moves {start - demand.since:.3f} s later, for {end - start:.3f} s, "
                f"beginning with {_words(velocity)}"
            )
            found.append(Violation(start, "motion", text))
    return found, took


def _slower(record: Sequence[SentVelocity], demand: Demand) -> list[Violation]:
    """Whether the robot is as slow as demanded."""
    fast = [
        told
        for told in record
        if demand.since + demand.within_s < told.at < demand.until
        and abs(told.velocity.linear) > demand.speed + _ROUNDING
    ]
    if not fast:
        return []
    fastest = max(abs(told.velocity.linear) for told in fast)
    text = f"{demand.why}: goes on at {fastest:.3f} m/s, where {demand.speed:.3f} m/s is the most"
    return [Violation(fast[0].at, "velocity", text, len(fast))]


def _merge(found: Sequence[tuple[float, str]], kind: str, wheels: Wheels) -> list[Violation]:
    """One violation for what happens in one go; the first sentence stands for all."""
    merged: list[Violation] = []
    last = -inf
    for at, text in found:
        if merged and at - last <= wheels.silence_s + wheels.jitter_s:
            before = merged[-1]
            merged[-1] = Violation(before.at, kind, before.text, before.times + 1)
        else:
            merged.append(Violation(at, kind, text))
        last = at
    return merged


def _words(velocity: Velocity) -> str:
    if velocity.angular == 0:
        return f"{velocity.linear:.3f} m/s"
    return f"{velocity.linear:.3f} m/s and {velocity.angular:.3f} rad/s"
