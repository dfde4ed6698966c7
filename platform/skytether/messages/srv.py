"""ROS services as pairs of messages: what a call asks, and what answers it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from .base import Message, message
from .geometry import PoseStamped
from .nav import OccupancyGrid, Path

Q = TypeVar("Q", bound=Message)
A = TypeVar("A", bound=Message)


@dataclass(frozen=True, slots=True)
class ServiceType(Generic[Q, A]):
    """A kind of call.

    Attributes:
        name: ROS 2 style, ``std_srvs/srv/SetBool``.
        request: Class of what is asked.
        response: Class of what is answered.
    """

    name: str
    request: type[Q]
    response: type[A]


@message("std_srvs/srv/Trigger_Request")
class TriggerRequest(Message):
    """Do it. Nothing is said but that; ROS 2 has a member in what is empty, ROS 1 has none."""

    structure_needs_at_least_one_member: int = 0


@message("std_srvs/srv/Trigger_Response")
class TriggerResponse(Message):
    """Whether it was done, and what to say of it."""

    success: bool = False
    message: str = ""


@message("std_srvs/srv/SetBool_Request")
class SetBoolRequest(Message):
    """Switch something on or off."""

    data: bool = False


@message("std_srvs/srv/SetBool_Response")
class SetBoolResponse(Message):
    """Whether it was switched, and what to say of it."""

    success: bool = False
    message: str = ""


@message("nav_msgs/srv/GetMap_Request")
class GetMapRequest(Message):
    """The map, please; empty as `TriggerRequest`."""

    structure_needs_at_least_one_member: int = 0


@message("nav_msgs/srv/GetMap_Response")
class GetMapResponse(Message):
    """The map."""

    map: OccupancyGrid = OccupancyGrid()


@message("nav_msgs/srv/GetPlan_Request")
class GetPlanRequest(Message):
    """A way between two poses; ``tolerance`` in m, if the goal cannot be reached."""

    start: PoseStamped = PoseStamped()
    goal: PoseStamped = PoseStamped()
    tolerance: float = 0.0


@message("nav_msgs/srv/GetPlan_Response")
class GetPlanResponse(Message):
    """The way; empty if there is none."""

    plan: Path = Path()


Trigger = ServiceType("std_srvs/srv/Trigger", TriggerRequest, TriggerResponse)
SetBool = ServiceType("std_srvs/srv/SetBool", SetBoolRequest, SetBoolResponse)
GetMap = ServiceType("nav_msgs/srv/GetMap", GetMapRequest, GetMapResponse)
GetPlan = ServiceType("nav_msgs/srv/GetPlan", GetPlanRequest, GetPlanResponse)
