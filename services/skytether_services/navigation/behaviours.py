"""The leaves of the behaviour tree: what the robot can be told to do, each with its parameters.

A leaf decides nothing about sensors or safety: while the robot's place is not known the tree is not asked at all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Literal, Protocol, TypeVar

from py_trees.behaviour import Behaviour
from py_trees.common import Status

from skytether.control.admittance import Velocity
from skytether.service import NoParams, param
from skytether_services.planar.geometry import Pose, wrap

from .status import Code, Trouble

P = TypeVar("P")
_REPLAN_BLOCKED = 0.3
"""Between two plans around something that is in the way [s]."""
_LOOK_AHEAD = 0.4
"""A turn, or a way back, has to be free for so long ahead [s]."""


class Robot(Protocol):
    """What leaves act on. All of it is of the present step; the last velocity that was told in it counts."""

    now: float
    """Seconds."""

    @property
    def pose(self) -> Pose:
        """On the map."""
        ...

    @property
    def plan_age(self) -> float:
        """Since the path to the present goal was found [s]; infinite: there is none."""
        ...

    @property
    def is_blocked(self) -> bool:
        """Whether something stands on the path ahead, or the controller finds no way."""
        ...

    def plan(self) -> Trouble | None:
        """Search a path to the present goal; None: it was found."""
        ...

    def follow(self) -> bool:
        """Drive along the path for one step; whether the goal is reached."""
        ...

    def is_stuck(self) -> bool:
        """Whether the robot has not got on for too long."""
        ...

    def clear(self, *, whole: bool, near: bool) -> None:
        """Forget what the laser saw, in the planner's and in the controller's costmap."""
        ...

    def creep(self, velocity: Velocity, ahead: float) -> bool:
        """Drive like this for one step; false, and stand, if that leads into something within so many seconds."""
        ...

    def turn_rate(self, left: float, most: float) -> float:
        """Turning rate that ends a turn of so much [rad] without overshoot, at most so fast [rad/s]."""
        ...

    def blame(self, trouble: Trouble) -> None:
        """Remember why something failed."""
        ...

    def recovered(self) -> None:
        """Count a recovery, and give the robot time again to get on."""
        ...


class Leaf(Behaviour, Generic[P]):
    """Base of the leaves. Its parameters are a dataclass, as those of services."""

    params_type: ClassVar[type[Any]] = NoParams

    def __init__(self, name: str, robot: Robot, params: P) -> None:
        super().__init__(name)
        self.robot = robot
        self.params = params


@dataclass(frozen=True)
class PlanParams:
    """Of `plan`."""

    every: float = param(0.0, unit="s", ge=0, doc="a new path when the last one is so old; 0: as rates.planner says")


class PlanPath(Leaf[PlanParams]):
    """`plan`: succeeds while there is a path; a new one when it is old, or something stands on it."""

    params_type = PlanParams
    period = 1.0
    """Of the planner, from the service's parameters [s]."""

    def update(self) -> Status:
        robot = self.robot
        age = robot.plan_age
        if age < (self.params.every or self.period) and not (robot.is_blocked and age >= _REPLAN_BLOCKED):
            return Status.SUCCESS
        trouble = robot.plan()
        if trouble is None:
            return Status.SUCCESS
        robot.blame(trouble)
        return Status.FAILURE


@dataclass(frozen=True)
class FollowParams:
    """Of `follow`."""

    patience: float = param(3.0, unit="s", ge=0, doc="fails when the way was blocked for so long")


class Follow(Leaf[FollowParams]):
    """`follow`: drives along the path until the goal is reached; fails when it is blocked, or stuck."""

    params_type = FollowParams

    def initialise(self) -> None:
        self._free_at = self.robot.now

    def update(self) -> Status:
        robot = self.robot
        if robot.follow():
            return Status.SUCCESS
        if not robot.is_blocked:
            self._free_at = robot.now
        elif robot.now - self._free_at > self.params.patience:
            robot.blame(Trouble(Code.BLOCKED, "Something is in the way, and there is no way around it."))
            return Status.FAILURE
        if robot.is_stuck():
            robot.blame(Trouble(Code.STUCK, "The robot does not get on."))
            return Status.FAILURE
        return Status.RUNNING


@dataclass(frozen=True)
class ClearParams:
    """Of `clear`."""

    costmap: Literal["local", "global", "both"] = param("both", doc="whose marks are forgotten")


class Clear(Leaf[ClearParams]):
    """`clear`: forgets what the laser saw; what is still there is marked again by the next scans."""

    params_type = ClearParams

    def update(self) -> Status:
        what = self.params.costmap
        self.robot.clear(whole=what != "local", near=what != "global")
        return Status.SUCCESS


@dataclass(frozen=True)
class RotateParams:
    """Of `rotate`."""

    angle: float = param(math.pi / 2, unit="rad", ge=-4 * math.pi, le=4 * math.pi, doc="positive: to the left")
    speed: float = param(0.6, unit="rad/s", gt=0, le=3, doc="largest turning rate")
    within: float = param(15.0, unit="s", gt=0, doc="fails when it takes longer")


class Rotate(Leaf[RotateParams]):
    """`rotate`: turns on the spot; fails where something is in the way."""

    params_type = RotateParams

    def initialise(self) -> None:
        self._began = self.robot.now
        self._left = self.params.angle
        self._yaw = self.robot.pose.yaw

    def update(self) -> Status:
        robot, params = self.robot, self.params
        yaw = robot.pose.yaw
        self._left -= wrap(yaw - self._yaw)
        self._yaw = yaw
        if abs(self._left) < 0.05 or self._left * params.angle <= 0:
            return Status.SUCCESS
        rate = robot.turn_rate(self._left, params.speed)
        if robot.now - self._began > params.within or not robot.creep(Velocity(0.0, rate), _LOOK_AHEAD):
            return Status.FAILURE
        return Status.RUNNING


@dataclass(frozen=True)
class BackUpParams:
    """Of `back_up`."""

    distance: float = param(0.2, unit="m", gt=0, le=5, doc="so far, straight")
    speed: float = param(0.1, unit="m/s", gt=0, le=1, doc="so fast")
    within: float = param(10.0, unit="s", gt=0, doc="fails when it takes longer")


class BackUp(Leaf[BackUpParams]):
    """`back_up`: drives straight back; fails where something is in the way."""

    params_type = BackUpParams

    def initialise(self) -> None:
        self._began = self.robot.now
        self._from = self.robot.pose

    def update(self) -> Status:
        robot, params = self.robot, self.params
        if math.dist(robot.pose[:2], self._from[:2]) >= params.distance:
            return Status.SUCCESS
        if robot.now - self._began > params.within or not robot.creep(Velocity(-params.speed, 0.0), _LOOK_AHEAD):
            return Status.FAILURE
        return Status.RUNNING


@dataclass(frozen=True)
class WaitParams:
    """Of `wait`."""

    seconds: float = param(2.0, unit="s", ge=0, le=3600, doc="so long")


class Wait(Leaf[WaitParams]):
    """`wait`: stands."""

    params_type = WaitParams

    def initialise(self) -> None:
        self._began = self.robot.now

    def update(self) -> Status:
        return Status.SUCCESS if self.robot.now - self._began >= self.params.seconds else Status.RUNNING


@dataclass(frozen=True)
class GiveUpParams:
    """Of `give_up`."""

    code: str = param(
        "", pattern=r"^([a-z][a-z0-9_]{0,62})?$", doc="told as the error code; none: that of what failed last"
    )
    message: str = param("", max_length=500, doc="told with it; none: the sentence of what failed last")


class GiveUp(Leaf[GiveUpParams]):
    """`give_up`: fails, and says why."""

    params_type = GiveUpParams

    def update(self) -> Status:
        if self.params.code or self.params.message:
            code = self.params.code or Code.GAVE_UP
            self.robot.blame(Trouble(code, self.params.message or "The goal was given up."))
        return Status.FAILURE


LEAVES: dict[str, type[Leaf[Any]]] = {
    "plan": PlanPath,
    "follow": Follow,
    "clear": Clear,
    "rotate": Rotate,
    "back_up": BackUp,
    "wait": Wait,
    "give_up": GiveUp,
}
"""By their names in the file."""
