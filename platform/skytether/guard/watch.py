"""What the wheels are told next. Pure: time is an argument.

It starts from what the wheels were really told last, never from what somebody wanted: a gap in the telling, a failed
write, or nobody who listens counts as standstill, because drives that hear nothing stop by themselves; and that is what
they are told first.
"""

from __future__ import annotations

from math import isfinite

from .kinematics import Bounds, brake, toward
from .protocol import Beat, LastCommand
from .velocity import STANDSTILL, Velocity

_ROUNDING = 1e-6


class Watch:
    """Follows what is wanted while that is fresh, a number and within the limits; else brakes.

    Args:
        bounds: Of the wheels.
        period_s: Of the loop; what a step counts for when the clock went back [s].
        patience_s: Oldest word that is followed, and longest gap in the telling that is no standstill [s].
    """

    def __init__(self, bounds: Bounds, period_s: float, patience_s: float) -> None:
        self.told = LastCommand()
        """What the wheels were told last."""
        self._bounds = bounds
        self._period_s = period_s
        self.patience_s = patience_s
        self._beat: Beat | None = None

    def on_beat(self, beat: Beat) -> None:
        """Take in what is wanted."""
        self._beat = beat

    def forget(self) -> None:
        """Whoever said what is wanted is gone."""
        self._beat = None

    def learn(self, told: LastCommand) -> None:
        """Somebody else told the wheels something; the newest counts."""
        if not self.told.at >= told.at and isfinite(told.at) and _finite(told.velocity):
            self.told = told

    def wrote(self, velocity: Velocity, at: float) -> None:
        """The wheels were told so."""
        self.told = LastCommand(velocity, at)

    def failed(self, at: float) -> None:
        """The wheels could not be told anything, or nobody listens."""
        self.told = LastCommand(STANDSTILL, at)

    def want(self, now: float, stopped: bool = False) -> tuple[Velocity, str]:
        """Decide what the wheels are told now.

        Args:
            now: [s]
            stopped: Brake, whatever is wanted.

        Returns:
            The velocity, and what is wrong with the one who says what is wanted (empty: nothing).
        """
        target, wrong = self.target(now, stopped)
        gap = now - self.told.at
        if self.goes_on(now):
            base, step = self.told.velocity, gap
        elif gap > self.patience_s or not isfinite(self.told.at):
            base, step = STANDSTILL, 0.0
        else:  # the clock went back, or is no number
            return brake(self._bounds, self.told.velocity, self._period_s), wrong or "has a clock that went back"
        return toward(self._bounds, base, target, step), wrong

    def goes_on(self, now: float) -> bool:
        """Whether what was told last still holds, and the next velocity begins there."""
        return 0 <= now - self.told.at <= self.patience_s

    def target(self, now: float, stopped: bool = False) -> tuple[Velocity, str]:
        """Where the wheels are to get, however far that is; see `want`."""
        wrong = self._wrong(now)
        if wrong or stopped or self._beat is None:
            return STANDSTILL, wrong
        return self._clipped(self._beat.velocity), ""

    def asks(self, now: float, stopped: bool = False) -> tuple[Velocity, float]:
        """What a writer is asked for: where the wheels are to get, and when that was wanted [s].

        Not a step towards it: two who hold the limits one after the other, each from the time of its own last turn, get
        less of it than one.
        """
        target, wrong = self.target(now, stopped)
        if wrong or stopped or self._beat is None:
            return target, now
        return target, self._beat.at

    def due(self, now: float, repeat_s: float, stopped: bool = False) -> float:
        """When the wheels are to be told something again, if nobody wants anything new until then [s].

        Args:
            now: They were told something just now [s].
            repeat_s: They are not left without a word for longer.
            stopped: See `want`.
        """
        target, wrong = self.target(now, stopped)
        if wrong or self._beat is None or target != self.told.velocity:
            return now + self._period_s
        return min(now + repeat_s, self._beat.at + self.patience_s + _ROUNDING)

    def _clipped(self, velocity: Velocity) -> Velocity:
        """Without what rounding has put beyond the limits."""
        bounds = self._bounds
        return Velocity(
            min(max(velocity.linear, bounds.linear_min), bounds.linear_max),
            min(max(velocity.angular, -bounds.angular_max), bounds.angular_max),
        )

    def _wrong(self, now: float) -> str:
        beat, bounds = self._beat, self._bounds
        if beat is None or not 0 <= now - beat.at + _ROUNDING <= self.patience_s:
            return "says nothing"
        linear, angular = beat.velocity
        if not _finite(beat.velocity):
            return "sends what is no number"
        if not bounds.linear_min - _ROUNDING <= linear <= bounds.linear_max + _ROUNDING:
            return f"wants {linear:g} m/s, which is beyond the limits"
        if abs(angular) > bounds.angular_max + _ROUNDING:
            return f"wants {angular:g} rad/s, which is beyond the limits"
        return ""


def _finite(velocity: Velocity) -> bool:
    return isfinite(velocity.linear) and isfinite(velocity.angular)
