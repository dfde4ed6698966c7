"""What the wheels really do, beside what they were told. Pure: time is an argument.

**The envelope.** What a reading of odometry shows now, the wheels did at most ``latency`` ago, and what they did then
follows from what they were told up to a dead time before. Wheels that follow without swinging past (first order, a ramp
of the drive's own) are at every moment a weighted mean of what they were told earlier. So a reading lies between the
least and the most that was told within the window

    latency + dead + settle,      settle = 4 lag

but for what is older: its weight is exp(-4) of the largest range of velocities, which is added to the tolerance.
Whatever is outside for ``confirm`` without a break is no wheel that follows. Inside may still be one that follows
badly: this looks for what is broken, and the zones rely on the braking that was measured.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from math import copysign, exp, inf, isfinite, nan

from skytether.guard.velocity import STANDSTILL, Velocity
from skytether.messages import Message, Odometry, Twist, TwistStamped
from skytether.robot.control.supervisor import VelocityLimits

from ..sensing.stamps import Stamp, StampRule, Stamps, date

_LAGS = 4.0
_PIECES = 4096
"""Changes of the told velocity that are kept: 8 s at 500 Hz."""
_TOLERANCE_S = 0.05
"""How far ahead of now a reading may have come."""


class Fault(StrEnum):
    """What the wheels do that they were not told; bounded, for counters."""

    RUNAWAY = "runaway"
    """Faster than told, or the other way round."""
    BRAKING = "braking"
    """Told to be slower, and not slower in time."""
    MOVES = "moves"
    """Stood, was told to stand, and moves."""
    BLOCKED = "blocked"
    """Told to move, and does not."""


@dataclass(frozen=True, slots=True)
class MotionParams:
    """How the wheels follow, and what is looked for.

    Attributes:
        latency_s: Oldest motion that a reading shows when it comes [s].
        dead_s: From a velocity that is told to its first effect at the wheels, guard and writer included [s].
        lag_s: Time in which the wheels do 63 % of a change [s].
        linear_tolerance: Noise of the readings and unevenness of the wheels [m/s].
        angular_tolerance: The same [rad/s].
        share: The same, of the velocity told.
        confirm_s: How long a reading must be outside the envelope [s].
        blocked_s: How long the wheels may stand when they are told to move [s].
        max_age_s: Age, and silence, after which the real motion is not known [s].
        stamps: What is asked of the stamps of the readings.
    """

    latency_s: float = 0.1
    dead_s: float = 0.2
    lag_s: float = 0.15
    linear_tolerance: float = 0.05
    angular_tolerance: float = 0.1
    share: float = 0.1
    confirm_s: float = 0.2
    blocked_s: float = 1.0
    max_age_s: float = 0.3
    stamps: StampRule = StampRule.AUTO

    @property
    def window_s(self) -> float:
        """How long ago something may have been told that a reading still shows [s]."""
        return self.latency_s + self.dead_s + _LAGS * self.lag_s


@dataclass(frozen=True, slots=True)
class MotionEstimate:
    """What is known of the real motion now.

    Attributes:
        measured: Velocity; None: not known.
        unknown: Why it is not known, for people; empty: it is.
        fault: What is broken; None: nothing that can be seen.
        detail: The fault for people.
    """

    measured: Velocity | None
    unknown: str = ""
    fault: Fault | None = None
    detail: str = ""


@dataclass(slots=True)
class _Piece:
    since: float
    until: float
    velocity: Velocity


class Motion:
    """Takes in what was told and what was measured.

    Args:
        params: Of wheels and readings.
        limits: Of the wheels.
        gap_s: Time without a word to the wheels that counts as standstill [s].
    """

    def __init__(self, params: MotionParams, limits: VelocityLimits, gap_s: float) -> None:
        self._params = params
        self._gap_s = gap_s
        rest = exp(-_LAGS)
        self._tolerance = Velocity(
            params.linear_tolerance + rest * (limits.linear_max - limits.linear_min),
            params.angular_tolerance + rest * 2 * limits.angular_max,
        )
        self._told: deque[_Piece] = deque(maxlen=_PIECES)
        self._measured = STANDSTILL
        self._measured_at = nan
        self._delay = 0.0
        self._stamps = Stamps()
        self._nonsense = ""
        self._since: dict[bool, float] = {}  # of what is outside: whether it is a wheel that stands -> since when
        self._stood = [False, False]
        self._fault: tuple[Fault, str] | None = None

    def told(self, velocity: Velocity, now: float) -> None:
        """Take in what the wheels are told from now on. After a gap they are taken to have been told a standstill."""
        last = self._told[-1] if self._told else None
        if last is not None and not last.until <= now < inf:  # the clock is gone, and with it the history
            self._told.clear()
            last = None
        if last is None or now - last.until > self._gap_s:
            self._told.append(_Piece(now if last is None else last.until, now, STANDSTILL))
        elif last.velocity == velocity:
            last.until = now
            return
        else:
            last.until = now
        self._told.append(_Piece(now, now, velocity))
        while len(self._told) > 1 and self._told[0].until < now - self._params.window_s:
            self._told.popleft()

    def measure(self, message: Message, now: float, wall: float = nan) -> str:
        """Take a reading in: Odometry, TwistStamped or Twist in the robot's base frame.

        One that comes later than the quickest so far is that much older; one that is stale by that is no fault of the
        wheels, which were told something else when it was made. ``wall``: see `stamps.date`.

        Returns:
            What is wrong with it; empty: nothing.
        """
        twist, stamp = twist_of(message), _stamp(message)
        if twist is None:
            return f"a {message.TYPE} is no odometry"
        dated = date(self._params.stamps, self._stamps, stamp, now, self._params.max_age_s, wall)
        self._stamps = dated.stamps
        if dated.wrong:
            return f"{_NOT_NEWER[dated.wrong]}, which counts as silence"
        self._measured_at, self._delay = now - dated.delay, dated.delay
        self._measured = Velocity(float(twist.linear.x), float(twist.angular.z))
        finite = isfinite(self._measured.linear) and isfinite(self._measured.angular)
        self._nonsense = "" if finite else "reports a velocity that is no number"
        if finite and dated.delay <= self._params.max_age_s:
            self._judge(now)
        return ""

    def relearn(self) -> None:
        """Forget how quick readings were, because a person looked at the robot."""
        self._stamps = Stamps()

    def estimate(self, now: float) -> MotionEstimate:
        """What is known now. A fault is told once, in the look after the reading that showed it."""
        fault, self._fault = self._fault, None
        age = now - self._measured_at
        unknown = self._nonsense
        if not -_TOLERANCE_S <= age <= self._params.max_age_s:
            late = f", and came {self._delay:.1f} s late by its stamp" if self._delay > _TOLERANCE_S else ""
            silent = f"is silent for {age - self._delay:.1f} s{late}"
            unknown = silent if isfinite(age) else "nothing has come yet"
            self._since.clear()
        measured = None if unknown else self._measured
        return MotionEstimate(measured, unknown, *fault) if fault else MotionEstimate(measured, unknown)

    def _judge(self, now: float) -> None:
        begin = now - self._params.window_s
        if not self._told or self._told[0].since > begin:  # what was told before is not known
            return
        pieces = [piece.velocity for piece in self._told if piece.until >= begin]
        if not pieces:  # this process stood still for longer than readings show
            self._since.clear()
            return
        stands = all(velocity == STANDSTILL for velocity in pieces)
        found: dict[bool, tuple[Fault, str]] = {}
        for axis, (verb, unit) in enumerate((("drives", "m/s"), ("turns", "rad/s"))):
            values = [velocity[axis] for velocity in pieces]
            least, most = min(values), max(values)
            fault = self._moving(axis) if stands else self._outside(axis, least, most, values[-1])
            if fault is not None:
                was = f"{least:.2f}" if least == most else f"{least:.2f} to {most:.2f}"
                detail = f"{_SAYS[fault]}: it {verb} at {self._measured[axis]:.2f} {unit} and was told {was} {unit}"
                found[fault is Fault.BLOCKED] = (fault, detail)
        self._since = {kind: self._since.get(kind, now) for kind in found}
        for kind, since in self._since.items():
            if now - since >= (self._params.blocked_s if kind else self._params.confirm_s):
                self._fault = found[kind]

    def _moving(self, axis: int) -> Fault | None:
        """What it means to move when a standstill was told all the time; None: it does not."""
        if abs(self._measured[axis]) <= self._tolerance[axis]:
            self._stood[axis] = True
            return None
        return Fault.MOVES if self._stood[axis] else Fault.BRAKING

    def _outside(self, axis: int, least: float, most: float, newest: float) -> Fault | None:
        """What a reading outside the envelope of one axis means; None: it is inside."""
        self._stood[axis] = False
        value, fastest = self._measured[axis], max(abs(least), abs(most))
        tolerance = self._tolerance[axis] + self._params.share * fastest
        if least - tolerance <= value <= most + tolerance:
            return None
        slowest = max(least, -most, 0.0)  # the least speed that was told, if it was one way round all the time
        along = copysign(1.0, least + most) * value
        if -tolerance <= along < slowest:  # with a load, up a slope; a standstill is told apart from what is slow
            return Fault.BLOCKED if abs(value) <= tolerance < slowest / 2 else None
        return Fault.BRAKING if abs(newest) < fastest < abs(value) else Fault.RUNAWAY


def twist_of(message: Message) -> Twist | None:
    """The velocity that a reading holds; None: it is no odometry."""
    if isinstance(message, Odometry):
        return message.twist.twist
    if isinstance(message, TwistStamped):
        return message.twist
    return message if isinstance(message, Twist) else None


def _stamp(message: Message) -> Stamp:
    if isinstance(message, Odometry | TwistStamped):
        return message.header.stamp.sec, message.header.stamp.nanosec
    return 0, 0


_NOT_NEWER: Mapping[str, str] = {
    "repeated": "sends the same reading again",
    "older": "sends a reading that is older than one before",
    "unstamped": "sends a reading without a stamp",
    "ahead": "sends a reading with a stamp that is ahead of this computer's clock",
}
"""What is wrong with a reading's stamp, by the kind that `stamps.date` tells."""
_SAYS: Mapping[Fault, str] = {
    Fault.RUNAWAY: "the wheels do not do what they were told",
    Fault.BRAKING: "the wheels do not brake",
    Fault.MOVES: "the robot moves while it was told to stand",
    Fault.BLOCKED: "the wheels do not move",
}
