"""The robot's dead reckoning over the last seconds: where it was at a moment, in a frame without jumps.

Odometry comes more often than scans, and not at the same moments. What jumps (a wheel slipped, the driver was started
anew) is taken out: the track goes on from where it was.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass

from .geometry import Pose, wrap
from .transforms import compose, inverse

_FURTHEST = 1e8
"""Further from the origin is no robot, not even in a frame of the whole earth, m."""
KEPT = 400
"""Samples: four seconds at 100 Hz."""
_BACK = 1.0
"""A stamp that is older than the newest by more is of another clock [s]; less is a message that was overtaken."""
_GAP = 1.0
"""A robot is taken to have moved for so long at most between two samples [s]."""


@dataclass(frozen=True, slots=True)
class Sample:
    """Odometry of one moment.

    Attributes:
        stamp: By the robot's clock [s].
        pose: In the track's frame.
        at: The same moment by the service's clock [s].
    """

    stamp: float
    pose: Pose
    at: float


@dataclass(frozen=True)
class Reach:
    """What no robot does between two samples.

    Attributes:
        linear: Faster than any speed of the robot [m/s].
        angular: Faster than it turns [rad/s].
        distance: Allowed beyond it [m].
        turn: Likewise [rad].
    """

    linear: float
    angular: float
    distance: float
    turn: float

    def allows(self, before: Pose, after: Pose, dt: float) -> bool:
        """Whether a robot may have moved so within dt [s]."""
        dt = min(max(dt, 0.0), _GAP)
        way = math.hypot(after.x - before.x, after.y - before.y)
        turned = abs(wrap(after.yaw - before.yaw))
        return way <= self.distance + self.linear * dt and turned <= self.turn + self.angular * dt


class OdometryTrack:
    """Samples in the order of their stamps."""

    def __init__(self, reach: Reach) -> None:
        self._reach = reach
        self._samples: list[Sample] = []
        self._raw: Pose | None = None
        self._anchor = Pose(0.0, 0.0, 0.0)

    @property
    def newest(self) -> Sample | None:
        """The last one."""
        return self._samples[-1] if self._samples else None

    def add(self, stamp: float, pose: Pose, at: float) -> bool:
        """Take a sample; what is not finite, on no robot's earth, or not newer than the last one, is left out.

        Args:
            stamp: By the robot's clock [s].
            pose: In the frame of its odometry.
            at: The same moment by the service's clock [s].

        Returns:
            Whether it jumped.
        """
        if not all(math.isfinite(value) for value in (stamp, *pose, at)) or math.hypot(pose.x, pose.y) > _FURTHEST:
            return False
        last = self.newest
        if last is None or self._raw is None:
            self._samples, self._raw = [Sample(stamp, pose, at)], pose
            return False
        new_clock = stamp < last.stamp - _BACK
        if stamp <= last.stamp and not new_clock:
            return False
        # By the service's clock, too: the robot's may have been set meanwhile.
        dt = max(at - last.at, 0.0) if new_clock else stamp - last.stamp
        jumped = not self._reach.allows(self._raw, pose, dt)
        if jumped:
            self._anchor = compose(last.pose, inverse(pose))
        if new_clock:
            self._samples.clear()
        self._raw = pose
        self._samples.append(Sample(stamp, compose(self._anchor, pose), at))
        del self._samples[:-KEPT]
        return jumped

    def pose_at(self, stamp: float) -> Pose | None:
        """Where the robot was; None before the first sample, and while none so new has come."""
        samples = self._samples
        if not samples or stamp < samples[0].stamp or stamp > samples[-1].stamp:
            return None
        index = bisect_left(samples, stamp, key=lambda sample: sample.stamp)
        after = samples[index]
        if after.stamp == stamp or index == 0:
            return after.pose
        before = samples[index - 1]
        share = (stamp - before.stamp) / (after.stamp - before.stamp)
        a, b = before.pose, after.pose
        turn = wrap(b.yaw - a.yaw)
        return Pose(a.x + share * (b.x - a.x), a.y + share * (b.y - a.y), wrap(a.yaw + share * turn))
