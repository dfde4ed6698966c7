"""Has the robot reached its goal, and does it get on at all?"""

from __future__ import annotations

import math
from dataclasses import dataclass

from skytether.control.admittance import Velocity
from skytether.service import param
from skytether_services.planar.geometry import Pose, wrap


@dataclass(frozen=True)
class GoalParams:
    """When a goal counts as reached."""

    distance: float = param(0.15, unit="m", gt=0, doc="nearer to the goal than this")
    heading: float = param(0.2, unit="rad", gt=0, doc="heading within this of the goal's; pi: any")
    stopped_linear: float = param(0.1, unit="m/s", gt=0, doc="and no faster than this")
    stopped_angular: float = param(0.25, unit="rad/s", gt=0, doc="and turning no faster than this")
    stateful: bool = param(True, doc="once it was near enough, only the heading is waited for")


@dataclass(frozen=True)
class ProgressParams:
    """When a robot counts as stuck."""

    distance: float = param(0.3, unit="m", gt=0, doc="it has to get this far,")
    turn: float = param(0.5, unit="rad", gt=0, doc="or to turn this far,")
    within: float = param(10.0, unit="s", gt=0, doc="within this time")


class GoalChecker:
    """For one goal after another."""

    def __init__(self, params: GoalParams) -> None:
        self._params = params
        self._near = False

    def reset(self) -> None:
        """There is another goal."""
        self._near = False

    def reached(self, pose: Pose, velocity: Velocity, goal: Pose) -> bool:
        """Whether the robot is at the goal; what is not finite is not."""
        params = self._params
        near = math.hypot(pose.x - goal.x, pose.y - goal.y) <= params.distance
        if params.stateful:
            near = self._near = self._near or near
        # Written so that NaN is never reached.
        return (
            near
            and abs(wrap(pose.yaw - goal.yaw)) <= params.heading
            and abs(velocity.linear) <= params.stopped_linear
            and abs(velocity.angular) <= params.stopped_angular
        )


class ProgressChecker:
    """Notices a robot that does not get on."""

    def __init__(self, params: ProgressParams) -> None:
        self._params = params
        self._since: tuple[Pose, float] | None = None

    def reset(self) -> None:
        """There is another goal, or the robot was told to wait."""
        self._since = None

    def stuck(self, pose: Pose, now: float) -> bool:
        """Whether the robot has not got on for too long.

        Args:
            pose: Of the robot; one that is not finite is no progress.
            now: Time on any clock that does not jump [s].
        """
        if self._since is None:
            self._since = (pose, now)
            return False
        before, since = self._since
        moved = math.hypot(pose.x - before.x, pose.y - before.y) >= self._params.distance
        turned = abs(wrap(pose.yaw - before.yaw)) >= self._params.turn
        if moved or turned:
            self._since = (pose, now)
            return False
        return now - since > self._params.within
