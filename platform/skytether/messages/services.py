"""Definitions of the ROS services that the codec knows, and what the hash of a ROS 2 service is made of."""

from __future__ import annotations

from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_msg

from .action_definitions import ROS2_ACTIONS

BOTH = {
    "std_srvs/srv/Empty": ("", ""),
    "std_srvs/srv/SetBool": ("bool data", "bool success\nstring message"),
    "std_srvs/srv/Trigger": ("", "bool success\nstring message"),
    "nav_msgs/srv/GetMap": ("", "nav_msgs/OccupancyGrid map"),
    "nav_msgs/srv/GetPlan": (
        "geometry_msgs/PoseStamped start\ngeometry_msgs/PoseStamped goal\nfloat32 tolerance",
        "nav_msgs/Path plan",
    ),
}
"""Request and response, the same in ROS 1 and ROS 2."""

ROS2_ONLY = {
    "action_msgs/srv/CancelGoal": (
        "action_msgs/GoalInfo goal_info",
        "int8 return_code\naction_msgs/GoalInfo[] goals_canceling",
    ),
    "example_interfaces/srv/AddTwoInts": ("int64 a\nint64 b", "int64 sum"),
    "rcl_interfaces/srv/SetParameters": (
        "rcl_interfaces/Parameter[] parameters",
        "rcl_interfaces/SetParametersResult[] results",
    ),
    **{
        f"{action}_{call}": (f"unique_identifier_msgs/UUID goal_id{more.format(action)}", response.format(action))
        for action in ROS2_ACTIONS
        for call, more, response in (
            ("SendGoal", "\n{}_Goal goal", "bool accepted\nbuiltin_interfaces/Time stamp"),
            ("GetResult", "", "int8 status\n{}_Result result"),
        )
    },
}


def service_types(name: str, request: str, response: str, *, hashed: bool) -> dict[str, Any]:
    """Types of a service, by name, as `rosbags` registers them.

    Args:
        name: ``std_srvs/srv/Trigger``.
        request: Definition in the ``.msg`` language.
        response: The same.
        hashed: Add what ROS 2 hashes: the service as a type of three members, the third an event that holds the
            first two (rosidl, ``rosidl_adapter`` and ``rosidl_parser``).
    """
    types: dict[str, Any] = {}
    for part, text in (("_Request", request), ("_Response", response)):
        ((_, types[name + part]),) = get_types_from_msg(text, "any/msg/Part").items()
    if not hashed:
        return types
    event: list[Any] = [("info", (Nodetype.NAME, "service_msgs/msg/ServiceEventInfo"))]
    event += [
        (p, (Nodetype.SEQUENCE, ((Nodetype.NAME, f"{name}_{p.capitalize()}"), 1))) for p in ("request", "response")
    ]
    types[f"{name}_Event"] = ([], event)
    parts = ("request", "response", "event")
    types[name] = ([], [(f"{p}_message", (Nodetype.NAME, f"{name}_{p.capitalize()}")) for p in parts])
    return types


def without_char(definition: Any) -> Any:
    """A definition with ``uint8`` in place of ``char``, which is the same in ROS 2 and is hashed as that."""
    if definition == (Nodetype.BASE, ("char", 0)):
        return (Nodetype.BASE, ("uint8", 0))
    if isinstance(definition, tuple | list):
        return type(definition)(map(without_char, definition))
    return definition
