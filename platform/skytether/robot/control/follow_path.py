"""The fallback ``path``: drives along a path that the robot itself knows, by its own odometry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite

from skytether.control.admittance import Velocity
from skytether.control.pursuit import PursuitParams, Track, pursue
from skytether.messages import Odometry, Path, yaw_of

from .fallback import Reading


class FollowPath:
    """Pure pursuit of fixed points, or of a path that one of the robot's own nodes publishes.

    It reads ``odom`` (nav_msgs/msg/Odometry; none older than ``limits.max_local_age_s`` is acted on) and,
    without ``points``, ``path`` (nav_msgs/msg/Path), both in one frame. At the end, and without a path, it stops.

    Args:
        points: Pairs of x and y [m] in the frame of the odometry; None: the topic's.
        odom: The reading with the robot's pose.
        path: The reading with the path.
        **options: Fields of `skytether.control.pursuit.PursuitParams`.
    """

    drives = True

    def __init__(
        self,
        points: Sequence[Sequence[float]] | None = None,
        odom: str = "odom",
        path: str = "path",
        **options: float,
    ) -> None:
        if points is not None and any(len(point) != 2 for point in points):
            raise ValueError("path: each of points must be a pair [x, y]")
        self._track = None if points is None else Track([(float(x), float(y)) for x, y in points])
        self._fixed = points is not None
        self._odom, self._path = odom, path
        self._known: object = None
        self._params = PursuitParams(**options)

    def step(self, _velocity: Velocity, readings: Mapping[str, Reading], _dt: float) -> tuple[Velocity, float] | None:
        """Aim at the path's point ahead."""
        if not self._fixed:
            self._update_track(readings.get(self._path))
        reading = readings.get(self._odom)
        if self._track is None or reading is None or not isinstance(reading.message, Odometry):
            return None
        pose = reading.message.pose.pose
        x, y, heading = pose.position.x, pose.position.y, yaw_of(pose.orientation)
        if not (isfinite(x) and isfinite(y) and isfinite(heading)):
            return None
        return pursue(self._params, self._track, x, y, heading), reading.read_at

    def _update_track(self, reading: Reading | None) -> None:
        """Take a new path; one that cannot be followed is none."""
        if reading is None or reading.message is self._known or not isinstance(reading.message, Path):
            return
        self._known = reading.message
        points = [(p.pose.position.x, p.pose.position.y) for p in reading.message.poses]
        try:
            self._track = Track(points)
        except ValueError:
            self._track = None
