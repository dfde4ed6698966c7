"""What follows from the real motion: who is told, whether the robot stands, and where a new driver begins. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf

from skytether.control.admittance import Velocity
from skytether.messages import Message
from skytether.robot.control.supervisor import VelocityLimits

from ..sensing.coverage import Action
from .motion import Motion, MotionParams


@dataclass(frozen=True, slots=True)
class OdometryRules:
    """What is configured.

    Attributes:
        topic: Of the readings.
        params: How the wheels follow.
        on_unknown: When the real motion is not known.
        latches: Whether a fault is an emergency stop; else it is named only.
        from_measured: Whether a new driver begins from the measured velocity, where that is the slower one.
    """

    topic: str = "odom"
    params: MotionParams = field(default_factory=MotionParams)
    on_unknown: Action = Action.STOP
    latches: bool = True
    from_measured: bool = False


class Handover:
    """Where a new driver begins: at the velocity that the wheels really have, if it is nearer to a standstill.

    The wheels may be slower than told, before a threshold or up a slope; once over it they would leap to what was told.
    So the told velocity falls to the measured one as fast as the robot may brake, and rises from there as fast as it
    may accelerate.

    Args:
        limits: Of the wheels.
        tolerance: Difference that is noise.
    """

    def __init__(self, limits: VelocityLimits, tolerance: Velocity) -> None:
        self._rates = Velocity(limits.linear_acceleration, limits.angular_acceleration)
        self._most = Velocity(max(limits.linear_max, -limits.linear_min), limits.angular_max)
        self._tolerance = tolerance
        self._hand = ""
        self._begun: tuple[float, float] | None = None
        self._at = 0.0

    def update(self, hand: str, told: Velocity, measured: Velocity | None, now: float) -> None:
        """Take in who drives from now on.

        Args:
            hand: Who drives.
            told: What the wheels were told last.
            measured: What they do; None: not known.
            now: Monotonic seconds.
        """
        if hand == self._hand:
            return
        self._hand, self._begun = hand, None
        if measured is not None:
            pairs = zip(told, measured, self._tolerance, strict=True)
            linear, angular = (_slower(old, real, noise) for old, real, noise in pairs)
            self._begun, self._at = (linear, angular), now

    def share(self, wanted: Velocity, now: float) -> float:
        """Of a velocity that may be told now."""
        if self._begun is None:
            return 1.0
        since = max(0.0, now - self._at)
        share = 1.0
        over = True
        for begun, rate, most, value in zip(self._begun, self._rates, self._most, wanted, strict=True):
            ceiling = begun + rate * since
            over = over and ceiling >= most
            if abs(value) > ceiling:
                share = min(share, ceiling / abs(value))
        if over:
            self._begun = None
        return share


def _slower(told: float, measured: float, tolerance: float) -> float:
    """The speed to begin at: the measured one where it is clearly slower than the told one; else any."""
    real = max(0.0, measured if told >= 0 else -measured)
    return real if real < abs(told) - tolerance else inf


class RealMotion:
    """Takes in what was told and measured, and says what follows.

    Args:
        rules: What is configured.
        limits: Of the wheels.
        gap_s: Time without a word to the wheels that counts as standstill [s].
    """

    def __init__(self, rules: OdometryRules, limits: VelocityLimits, gap_s: float) -> None:
        self._rules = rules
        self._motion = Motion(rules.params, limits, gap_s)
        tolerance = Velocity(rules.params.linear_tolerance, rules.params.angular_tolerance)
        self._handover = Handover(limits, tolerance)
        self.action = Action.FREE
        """What the last look asks for."""
        self._measured: Velocity | None = None

    def told(self, velocity: Velocity, now: float) -> None:
        """What the wheels are told from now on."""
        self._motion.told(velocity, now)

    def measure(self, message: Message, now: float, wall: float) -> str:
        """Take a reading in; what is wrong with it (empty: nothing). ``wall``: see `stamps.date`."""
        return self._motion.measure(message, now, wall)

    def relearn(self) -> None:
        """See `Motion.relearn`."""
        self._motion.relearn()

    def update(self, now: float, troubles: dict[str, str]) -> str:
        """What is known now.

        Returns:
            Why the robot must stand until a reset; empty: it need not.
        """
        rules, seen = self._rules, self._motion.estimate(now)
        self.action = rules.on_unknown if seen.unknown else Action.FREE
        if self.action is not Action.FREE:
            verb = "stands" if self.action is Action.STOP else "goes slowly"
            troubles["odometry:unknown"] = (
                f"{rules.topic}: {seen.unknown}: the real motion is not known; the robot {verb}"
            )
        self._measured = seen.measured
        if seen.fault is None:
            return ""
        troubles[f"odometry:{seen.fault}"] = f"{rules.topic}: {seen.detail}"
        return seen.detail if rules.latches else ""

    def share(self, hand: str, before: Velocity, wanted: Velocity, now: float) -> float:
        """What a new driver may have of a velocity, so that it begins from the measured one."""
        if not self._rules.from_measured:
            return 1.0
        self._handover.update(hand, before, self._measured, now)
        return self._handover.share(wanted, now)
