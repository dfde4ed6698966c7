"""Where the walker is: from the accumulated angles of its wheels, anchored to the robot's own odometry.

A wheel message is a state, not an increment, so lost ones cost nothing but the shape of the arc between two that
arrived. The robot's own odometry comes ten times less often; each one anchors the pose at its own time, and the wheels
since then carry it on. So there is nothing here that a restart or a long gap could lose.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from typing import NamedTuple

from skytether_services.virtual_trail.path import Pose, advance

_HISTORY = 200
"""Wheel samples kept to find the one of an odometry message's time: 2 s at 100 Hz."""

_RESTART = 5.0
"""A stamp this much older than the newest comes from a robot whose clock started anew, s."""


class Wheels(NamedTuple):
    """Accumulated angles [rad] of both wheels at the robot's time ``stamp`` [s]."""

    stamp: float
    left: float
    right: float


def roll(pose: Pose, before: Wheels, after: Wheels, *, radius: float, track: float) -> Pose:
    """The pose after the wheels rolled on, by exact integration of the arc.

    Args:
        pose: At ``before``.
        before: Earlier wheel angles.
        after: Later wheel angles.
        radius: Of the wheels [m].
        track: Distance between the wheels [m].
    """
    left, right = radius * (after.left - before.left), radius * (after.right - before.right)
    return advance(pose, (left + right) / 2, (right - left) / track)


class Odometry:
    """Anchored dead reckoning."""

    def __init__(self, *, radius: float, track: float) -> None:
        """Radius of the wheels and distance between them [m]."""
        self._radius, self._track = radius, track
        self._history: deque[Wheels] = deque(maxlen=_HISTORY)
        self._waiting: tuple[float, Pose] | None = None
        self.pose: Pose | None = None
        """Pose at the newest wheel sample; None until an anchor came."""

    def wheels(self, sample: Wheels) -> bool:
        """Take one wheel sample; False if it is not newer than the last and was ignored."""
        if self._history and sample.stamp < self._history[-1].stamp - _RESTART:
            self._history.clear()
            self._waiting = self.pose = None
        if self._history and sample.stamp <= self._history[-1].stamp:
            return False
        if self.pose is not None:
            self.pose = self._roll(self.pose, self._history[-1], sample)
        self._history.append(sample)
        if self._waiting is not None:
            self.anchor(*self._waiting)
        return True

    def anchor(self, stamp: float, pose: Pose) -> None:
        """The robot says where it was at ``stamp``: kept until the wheels reach that time, ignored if too old."""
        if not self._history or stamp > self._history[-1].stamp:
            self._waiting = (stamp, pose)
            return
        self._waiting = None
        if stamp < self._history[0].stamp:
            return
        index = bisect_left(self._history, stamp, key=lambda sample: sample.stamp)
        then = _between(self._history[max(index - 1, 0)], self._history[index], stamp)
        for sample in list(self._history)[index:]:
            pose, then = self._roll(pose, then, sample), sample
        self.pose = pose

    def _roll(self, pose: Pose, before: Wheels, after: Wheels) -> Pose:
        return roll(pose, before, after, radius=self._radius, track=self._track)


def _between(first: Wheels, second: Wheels, stamp: float) -> Wheels:
    """Wheel angles at a time between two samples, linearly."""
    if second.stamp == first.stamp:
        return second
    share = (stamp - first.stamp) / (second.stamp - first.stamp)
    return Wheels(
        stamp,
        first.left + share * (second.left - first.left),
        first.right + share * (second.right - first.right),
    )
