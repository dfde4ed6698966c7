"""Definitions of the actions that have classes here, in the words of ``.msg`` files; see `definitions`.

Actions differ between the generations: what is listed as of one is never turned into the other's.
"""

from __future__ import annotations

from collections.abc import Mapping

ONE_GENERATION = ("move_base_msgs", "action_msgs", "unique_identifier_msgs", "nav2_msgs")
"""Packages of which only ROS 1 or only ROS 2 has the types below. (``actionlib_msgs`` is in both.)"""

ROS2_ACTIONS = ("nav2_msgs/action/NavigateToPose", "nav2_msgs/action/NavigateThroughPoses")

_STAMPED = "geometry_msgs/msg/PoseStamped"
_DURATION = "builtin_interfaces/msg/Duration"
_ID = "unique_identifier_msgs/msg/UUID goal_id"
_NAV2_RESULT = "uint16 NONE=0, uint16 error_code, string error_msg"
_NAV2_FEEDBACK = (
    f"{_STAMPED} current_pose, {_DURATION} navigation_time, {_DURATION} estimated_time_remaining, "
    "int16 number_of_recoveries, float32 distance_remaining"
)


def _ros1(name: str, parts: Mapping[str, str]) -> dict[str, str]:
    """An action of ROS 1 (actionlib_msgs, ``genaction.py``)."""
    status = "std_msgs/msg/Header header, actionlib_msgs/msg/GoalStatus status"
    return {
        **{name + part: text for part, text in parts.items()},
        f"{name}ActionGoal": f"std_msgs/msg/Header header, actionlib_msgs/msg/GoalID goal_id, {name}Goal goal",
        f"{name}ActionResult": f"{status}, {name}Result result",
        f"{name}ActionFeedback": f"{status}, {name}Feedback feedback",
    }


def _ros2(name: str, parts: Mapping[str, str]) -> dict[str, str]:
    """An action of ROS 2 (rosidl_parser, ``definition.py``, class Action)."""
    return {
        **{f"{name}_{part}": text for part, text in parts.items()},
        f"{name}_SendGoal_Request": f"{_ID}, {name}_Goal goal",
        f"{name}_SendGoal_Response": "bool accepted, builtin_interfaces/msg/Time stamp",
        f"{name}_GetResult_Request": _ID,
        f"{name}_GetResult_Response": f"int8 status, {name}_Result result",
        f"{name}_FeedbackMessage": f"{_ID}, {name}_Feedback feedback",
    }


ACTIONS = {
    "actionlib_msgs/msg/GoalID": "builtin_interfaces/msg/Time stamp, string id",
    "actionlib_msgs/msg/GoalStatus": (
        "uint8 PENDING=0, uint8 ACTIVE=1, uint8 PREEMPTED=2, uint8 SUCCEEDED=3, uint8 ABORTED=4, uint8 REJECTED=5, "
        "uint8 PREEMPTING=6, uint8 RECALLING=7, uint8 RECALLED=8, uint8 LOST=9, "
        "actionlib_msgs/msg/GoalID goal_id, uint8 status, string text"
    ),
    "actionlib_msgs/msg/GoalStatusArray": ("std_msgs/msg/Header header, actionlib_msgs/msg/GoalStatus[] status_list"),
    "unique_identifier_msgs/msg/UUID": "uint8[16] uuid",
    "action_msgs/msg/GoalInfo": f"{_ID}, builtin_interfaces/msg/Time stamp",
    "action_msgs/msg/GoalStatus": (
        "int8 STATUS_UNKNOWN=0, int8 STATUS_ACCEPTED=1, int8 STATUS_EXECUTING=2, int8 STATUS_CANCELING=3, "
        "int8 STATUS_SUCCEEDED=4, int8 STATUS_CANCELED=5, int8 STATUS_ABORTED=6, "
        "action_msgs/msg/GoalInfo goal_info, int8 status"
    ),
    "action_msgs/msg/GoalStatusArray": "action_msgs/msg/GoalStatus[] status_list",
    "action_msgs/srv/CancelGoal_Request": "action_msgs/msg/GoalInfo goal_info",
    "action_msgs/srv/CancelGoal_Response": "int8 return_code, action_msgs/msg/GoalInfo[] goals_canceling",
    **_ros1(
        "move_base_msgs/msg/MoveBase",
        {
            "Goal": f"{_STAMPED} target_pose",
            "Result": "uint8 structure_needs_at_least_one_member",
            "Feedback": f"{_STAMPED} base_position",
        },
    ),
    # As of Jazzy: Humble's results are empty, and later ones have more in their feedback.
    **_ros2(
        "nav2_msgs/action/NavigateToPose",
        {"Goal": f"{_STAMPED} pose, string behavior_tree", "Result": _NAV2_RESULT, "Feedback": _NAV2_FEEDBACK},
    ),
    **_ros2(
        "nav2_msgs/action/NavigateThroughPoses",
        {
            "Goal": f"{_STAMPED}[] poses, string behavior_tree",
            "Result": _NAV2_RESULT,
            "Feedback": f"{_NAV2_FEEDBACK}, int16 number_of_poses_remaining",
        },
    ),
}
"""By type name."""
