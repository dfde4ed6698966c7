"""What a controller is: from the robot's state, a path and a costmap to a velocity, 30 times a second."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.service import param
from skytether_services.planar.geometry import Pose, wrap

from .costmap import Costmap


@dataclass(frozen=True)
class MotionLimits:
    """What a robot with differential drive can do."""

    max_linear: float = param(0.5, unit="m/s", gt=0, doc="largest forward speed")
    max_backward: float = param(0.1, unit="m/s", ge=0, doc="largest backward speed; 0: never backwards")
    max_angular: float = param(1.0, unit="rad/s", gt=0, doc="largest turning rate")
    linear_acceleration: float = param(1.0, unit="m/s^2", gt=0, doc="largest change of the speed, up and down")
    angular_acceleration: float = param(2.0, unit="rad/s^2", gt=0, doc="largest change of the turning rate")


class ControlStatus(StrEnum):
    """What a controller found."""

    DRIVING = "driving"
    BLOCKED = "blocked"
    NO_PATH = "no_path"
    NOT_FINITE = "not_finite"


@dataclass(frozen=True)
class Control:
    """One step's result.

    Attributes:
        velocity: The command; standstill where there is none to give.
        status: Why.
        trajectory: Where it leads, as far as the controller looks: x [m], y [m], yaw [rad], n by 3; for display.
    """

    velocity: Velocity
    status: ControlStatus
    trajectory: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))


class Controller(Protocol):
    """MPPI and DWA; others may join."""

    def set_path(self, path: NDArray[np.float64]) -> None:
        """Follow another path: x [m], y [m], yaw [rad], n by 3, evenly spaced, in the costmap's frame. Empty: none."""
        ...

    def reset(self) -> None:
        """Forget what was planned: the robot was stopped, moved or steered by somebody else."""
        ...

    def control(self, pose: Pose, velocity: Velocity, costmap: Costmap, *, speed_limit: float = math.inf) -> Control:
        """The command for the robot that has this pose and velocity when the command arrives.

        Args:
            pose: In the costmap's frame.
            velocity: Likewise when the command arrives.
            costmap: Inflated, around the robot.
            speed_limit: Of a zone [m/s]; at most the robot's own counts.
        """
        ...


class FollowedPath:
    """A path, and how far along it the robot has come."""

    _AHEAD = 1.0
    """How far ahead of the last place the next one is looked for [m]: a path that crosses itself is not cut."""
    _LOST = 0.6
    """Farther from the path than this the whole of it is looked at [m]."""

    def __init__(self, path: NDArray[np.float64]) -> None:
        """Raises ValueError for what is not n by 3, or not finite."""
        path = np.asarray(path, dtype=np.float64)
        if path.ndim != 2 or path.shape[1] != 3 or not np.isfinite(path).all():
            raise ValueError("path: it must be n by 3 (x, y, yaw), all finite")
        self.poses = path
        steps = np.hypot(*np.diff(path[:, :2], axis=0).T) if len(path) > 1 else np.empty(0)
        self._along = np.concatenate(([0.0], np.cumsum(steps)))
        self._index = 0

    @property
    def goal(self) -> Pose:
        """Its end."""
        return Pose(*self.poses[-1].tolist())

    def locate(self, x: float, y: float) -> int:
        """Index of the nearest pose: near the last one, or anywhere for a robot that was moved."""
        low = int(np.searchsorted(self._along, self._along[self._index] - self._AHEAD / 2))
        high = int(np.searchsorted(self._along, self._along[self._index] + self._AHEAD, side="right"))
        distances = np.hypot(self.poses[low:high, 0] - x, self.poses[low:high, 1] - y)
        nearest = int(distances.argmin())
        if distances[nearest] > self._LOST:
            low = 0
            distances = np.hypot(self.poses[:, 0] - x, self.poses[:, 1] - y)
            nearest = int(distances.argmin())
        self._index = low + nearest
        return self._index

    def ahead(self, x: float, y: float, length: float, spacing: float) -> NDArray[np.float64]:
        """The path from beside the robot on, evenly spaced [m], n by 3; at most so long [m], at least its end."""
        first = self.locate(x, y)
        start = self._along[first]
        end = min(start + length, self._along[-1])
        n = max(1, math.ceil((end - start) / spacing - 1e-9))
        at = np.linspace(start, end, n + 1) if end > start else np.array([end])
        poses = np.column_stack([np.interp(at, self._along, self.poses[:, i]) for i in (0, 1)])
        turns = self.poses[np.searchsorted(self._along, at - 1e-9).clip(0, len(self.poses) - 1), 2]
        return np.column_stack((poses, turns))

    def left(self) -> float:
        """Way from the last place to the end [m]."""
        return float(self._along[-1] - self._along[self._index])


class PathController(ABC):
    """A `Controller`, but for what it is about: it refuses what cannot be driven, and asks ``drive`` for the rest."""

    def __init__(self) -> None:
        """Begin without a path."""
        self._path: FollowedPath | None = None

    def set_path(self, path: NDArray[np.float64]) -> None:
        """As in `Controller`; raises ValueError for what is no path."""
        self._path = FollowedPath(path) if len(path) else None

    @abstractmethod
    def reset(self) -> None:
        """As in `Controller`."""

    @abstractmethod
    def drive(
        self, path: FollowedPath, pose: Pose, velocity: Velocity, costmap: Costmap, speed_limit: float
    ) -> Control:
        """The command; all numbers are finite, but for a limit that is none."""

    def control(self, pose: Pose, velocity: Velocity, costmap: Costmap, *, speed_limit: float = math.inf) -> Control:
        """As in `Controller`."""
        if self._path is None:
            self.reset()
            return Control(STANDSTILL, ControlStatus.NO_PATH)
        if not all(math.isfinite(value) for value in (*pose, *velocity)) or math.isnan(speed_limit):
            self.reset()
            return Control(STANDSTILL, ControlStatus.NOT_FINITE)
        return self.drive(self._path, pose, velocity, costmap, speed_limit)


def turn_towards(error: float, angular: float, limits: MotionLimits, dt: float) -> float:
    """Turning rate that ends a turn on the spot without overshoot [rad/s].

    The fastest from which the robot can still brake within the error left: sqrt(2 a |error|), and no more of a change
    than its acceleration allows.

    Args:
        error: Desired minus actual yaw [rad].
        angular: The rate that it has [rad/s].
        limits: Of the robot.
        dt: Time until the next command [s].
    """
    error = wrap(error)
    fastest = min(limits.max_angular, math.sqrt(2 * 0.7 * limits.angular_acceleration * abs(error)), abs(error) / dt)
    change = limits.angular_acceleration * dt
    return min(max(math.copysign(fastest, error), angular - change), angular + change)


def braking(velocity: Velocity, limits: MotionLimits, dt: float) -> Velocity:
    """The velocity after braking as hard as the robot may for dt [s]."""
    linear, angular = limits.linear_acceleration * dt, limits.angular_acceleration * dt
    return Velocity(
        math.copysign(max(abs(velocity.linear) - linear, 0.0), velocity.linear),
        math.copysign(max(abs(velocity.angular) - angular, 0.0), velocity.angular),
    )
