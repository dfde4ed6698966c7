"""Where the robot has got to since a scan was taken, by what its wheels were told. Pure: time is an argument.

A scan shows things as they lay when it came; the robot has moved since, maybe on other curves than its present one.
Its wheels follow what they are told late, by nobody knows exactly how much. So there are two answers: how the
things lie now, had the wheels followed at once, and how far that can be wrong if they are late.

**How wrong.** If the wheels follow ``late`` seconds later, they did at each time what was told ``late`` before. The
way of a thing as the robot sees it changes by |dv| + |dw| * distance per second where two motions differ by dv and
dw (a common turn keeps distances), and over all time |f(t - late) - f(t)| adds up to ``late`` times the variation
of f. Only getting faster on the same curve, a start among it, is no error: the robot is then not yet as far as it
is thought to be.
"""

from __future__ import annotations

from collections import deque
from math import cos, isfinite, sin
from typing import NamedTuple

import numpy as np

from skytether.guard.velocity import Velocity

from .footprint import Points

_TURNS = 8192
"""Turns that are remembered: 16 s at 500 Hz, more than any scan may be old."""


class Variation(NamedTuple):
    """How much the told velocity has changed, other than getting faster on the same curve; all changes added up."""

    linear: float
    """[m/s]"""
    angular: float
    """[rad/s]"""


class _Told(NamedTuple):
    at: float
    velocity: Velocity
    x: float
    y: float
    heading: float
    varied: Variation


class DeadReckoning:
    """Remembers what the wheels were told.

    Args:
        longest_s: How far back it is asked [s].
    """

    def __init__(self, longest_s: float) -> None:
        self._longest = longest_s
        self._told: deque[_Told] = deque(maxlen=_TURNS)

    def update(self, velocity: Velocity, now: float) -> None:
        """The wheels are told this from now on."""
        told = self._told
        if not isfinite(now) or (told and now < told[-1].at):  # nothing before can be placed in time any more
            told.clear()
        if not isfinite(now):
            return
        if not told:
            told.append(_Told(now, velocity, 0.0, 0.0, 0.0, Variation(0.0, 0.0)))
            return
        last = told[-1]
        x, y, heading = _moved(last, now)
        more = variation(last.velocity, velocity)
        varied = Variation(last.varied.linear + more.linear, last.varied.angular + more.angular)
        told.append(_Told(now, velocity, x, y, heading, varied))
        while len(told) > 2 and told[1].at <= now - self._longest:
            told.popleft()

    def now_at(self, points: Points, since: float, now: float) -> Points:
        """Where things lie now in the base frame that lay at ``points`` then, shape (n, 2), had the wheels no delay."""
        if not self._told or not len(points):
            return points
        (x0, y0, then), (x1, y1, heading) = self._pose(since), self._pose(now)
        dx, dy, turn = x1 - x0, y1 - y0, heading - then
        if dx == dy == turn == 0:
            return points
        c, s = cos(then), sin(then)
        forward, left = c * dx + s * dy, c * dy - s * dx
        c, s = cos(turn), sin(turn)
        moved: Points = (points - (forward, left)) @ np.array([[c, -s], [s, c]])
        return moved

    def varied(self, since: float, velocity: Velocity) -> Variation:
        """All changes since then, with the one to ``velocity`` now."""
        if not self._told:
            return Variation(0.0, 0.0)
        last, first = self._told[-1], self._before(since)
        more = variation(last.velocity, velocity)
        return Variation(
            last.varied.linear - first.varied.linear + more.linear,
            last.varied.angular - first.varied.angular + more.angular,
        )

    def _pose(self, at: float) -> tuple[float, float, float]:
        return _moved(self._before(at), at)

    def _before(self, at: float) -> _Told:
        """What was told then; of a time before all, the oldest, at which the robot stood."""
        for told in reversed(self._told):
            if told.at <= at:
                return told
        return self._told[0]


def variation(before: Velocity, after: Velocity) -> Variation:
    """How much one change of velocity varies, other than getting faster on the same curve."""
    squared = before.linear**2 + before.angular**2
    if not squared:
        return Variation(0.0, 0.0)
    scale = max(1.0, (before.linear * after.linear + before.angular * after.angular) / squared)
    return Variation(abs(after.linear - scale * before.linear), abs(after.angular - scale * before.angular))


def _moved(told: _Told, at: float) -> tuple[float, float, float]:
    """On the arc from a turn on; before the first turn the robot stood."""
    linear, angular = told.velocity
    dt = max(0.0, at - told.at)
    turn = angular * dt
    if abs(turn) < 1e-9:
        along, across = linear * dt, 0.0
    else:
        along, across = linear / angular * sin(turn), linear / angular * (1 - cos(turn))
    c, s = cos(told.heading), sin(told.heading)
    return told.x + c * along - s * across, told.y + s * along + c * across, told.heading + turn
