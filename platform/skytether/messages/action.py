"""ROS actions: a goal, what comes back of it, and the messages that carry both, of either ROS generation.

Fields as `actionlib` (ROS 1) and `rosidl` (ROS 2) generate them around an action's three own messages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Literal, TypeVar

import numpy as np

from .base import Message, Uint8s, array, message
from .geometry import PoseStamped
from .srv import ServiceType
from .std import Duration, Header, Time

G = TypeVar("G", bound=Message)
R = TypeVar("R", bound=Message)
F = TypeVar("F", bound=Message)


@dataclass(frozen=True, slots=True)
class ActionType(Generic[G, R, F]):
    """A kind of action.

    Attributes:
        name: ROS 2 style, ``move_base_msgs/action/MoveBase``.
        kind: ``action`` for ROS 1, ``ros2_action`` for ROS 2: the manifest's word.
        goal: Class of what a client asks for.
        result: Of what it gets at the end.
        feedback: Of what it gets meanwhile.
        wrappers: Classes that carry these over a graph, by the last part of their type's name.
    """

    name: str
    kind: Literal["action", "ros2_action"]
    goal: type[G]
    result: type[R]
    feedback: type[F]
    wrappers: Mapping[str, Any]

    @property
    def classes(self) -> list[type[Message]]:
        """Messages that it stands for, for `skytether.messages.warm`."""
        return list(self.wrappers.values())


@message("actionlib_msgs/msg/GoalID")
class GoalID(Message):
    """A goal of ROS 1. In a cancellation: an empty id and no time are all goals, a time all up to then."""

    stamp: Time = Time()
    id: str = ""


@message("actionlib_msgs/msg/GoalStatus")
class ActionlibGoalStatus(Message):
    """How far a goal of ROS 1 has come.

    ``status``: 0 pending, 1 active, 2 preempted, 3 succeeded, 4 aborted, 5 rejected, 6 preempting, 7 recalling,
    8 recalled.
    """

    goal_id: GoalID = GoalID()
    status: int = 0
    text: str = ""


@message("actionlib_msgs/msg/GoalStatusArray")
class ActionlibGoalStatusArray(Message):
    """All goals that a server of ROS 1 has or had a moment ago."""

    header: Header = Header()
    status_list: Sequence[ActionlibGoalStatus] = ()


@message("unique_identifier_msgs/msg/UUID")
class UUID(Message):
    """16 bytes."""

    uuid: Uint8s = array(np.uint8, 16)


@message("action_msgs/msg/GoalInfo")
class GoalInfo(Message):
    """A goal of ROS 2, and when it was accepted. In a cancellation: zeros are all goals, a time all up to then."""

    goal_id: UUID = UUID()
    stamp: Time = Time()


@message("action_msgs/msg/GoalStatus")
class GoalStatus(Message):
    """How far a goal of ROS 2 has come: 1 accepted, 2 executing, 3 canceling, 4 succeeded, 5 canceled, 6 aborted."""

    goal_info: GoalInfo = GoalInfo()
    status: int = 0


@message("action_msgs/msg/GoalStatusArray")
class GoalStatusArray(Message):
    """All goals that a server of ROS 2 accepted and has not forgotten."""

    status_list: Sequence[GoalStatus] = ()


@message("action_msgs/srv/CancelGoal_Request")
class CancelGoalRequest(Message):
    """Which goals are to be called off."""

    goal_info: GoalInfo = GoalInfo()


@message("action_msgs/srv/CancelGoal_Response")
class CancelGoalResponse(Message):
    """Which of them will be. ``return_code``: 0 none failed, 1 rejected, 2 unknown goal, 3 it has ended already."""

    return_code: int = 0
    goals_canceling: Sequence[GoalInfo] = ()


CancelGoal = ServiceType("action_msgs/srv/CancelGoal", CancelGoalRequest, CancelGoalResponse)


def _made(name: str, doc: str, **fields: Any) -> type[Message]:
    """A message class of these fields and their defaults, which are of the fields' types."""
    kinds = {key: type(value) for key, value in fields.items()}
    body = {"__doc__": doc, "__module__": __name__, "__annotations__": kinds, **fields}
    return message(name)(type(name.rpartition("/")[2], (Message,), body))


def ros1_action(name: str, goal: type[G], result: type[R], feedback: type[F]) -> ActionType[G, R, F]:
    """An action of ROS 1, from its three messages (``x_msgs/msg/DoGoal`` and so on)."""
    base = name.replace("/action/", "/msg/")
    status = {"header": Header(), "status": ActionlibGoalStatus()}
    wrappers = {
        "ActionGoal": _made(f"{base}ActionGoal", "A goal.", header=Header(), goal_id=GoalID(), goal=goal()),
        "ActionResult": _made(f"{base}ActionResult", "A goal's end.", **status, result=result()),
        "ActionFeedback": _made(f"{base}ActionFeedback", "What became of it so far.", **status, feedback=feedback()),
    }
    return ActionType(name, "action", goal, result, feedback, wrappers)


def ros2_action(name: str, goal: type[G], result: type[R], feedback: type[F]) -> ActionType[G, R, F]:
    """An action of ROS 2, from its three messages (``x_msgs/action/Do_Goal`` and so on)."""
    parts: dict[str, tuple[str, dict[str, Any]]] = {
        "SendGoal_Request": ("A goal.", {"goal_id": UUID(), "goal": goal()}),
        "SendGoal_Response": ("Whether it is pursued.", {"accepted": False, "stamp": Time()}),
        "GetResult_Request": ("The result, once there is one.", {"goal_id": UUID()}),
        "GetResult_Response": ("A goal's end.", {"status": 0, "result": result()}),
        "FeedbackMessage": ("What became of it so far.", {"goal_id": UUID(), "feedback": feedback()}),
    }
    wrappers = {part: _made(f"{name}_{part}", doc, **fields) for part, (doc, fields) in parts.items()}
    return ActionType(name, "ros2_action", goal, result, feedback, wrappers)


@message("move_base_msgs/msg/MoveBaseGoal")
class MoveBaseGoal(Message):
    """Where to go."""

    target_pose: PoseStamped = PoseStamped()


@message("move_base_msgs/msg/MoveBaseResult")
class MoveBaseResult(Message):
    """Nothing more than the status says."""

    structure_needs_at_least_one_member: int = 0


@message("move_base_msgs/msg/MoveBaseFeedback")
class MoveBaseFeedback(Message):
    """Where the robot is."""

    base_position: PoseStamped = PoseStamped()


@message("nav2_msgs/action/NavigateToPose_Goal")
class NavigateToPoseGoal(Message):
    """Where to go, and by which behaviour tree, unless by the usual one."""

    pose: PoseStamped = PoseStamped()
    behavior_tree: str = ""


@message("nav2_msgs/action/NavigateToPose_Result")
class NavigateToPoseResult(Message):
    """Why it ended: 0 nothing is wrong, else one of Nav2's codes."""

    error_code: int = 0
    error_msg: str = ""


@message("nav2_msgs/action/NavigateToPose_Feedback")
class NavigateToPoseFeedback(Message):
    """Where the robot is, and how far it is from the goal, m."""

    current_pose: PoseStamped = PoseStamped()
    navigation_time: Duration = Duration()
    estimated_time_remaining: Duration = Duration()
    number_of_recoveries: int = 0
    distance_remaining: float = 0.0


@message("nav2_msgs/action/NavigateThroughPoses_Goal")
class NavigateThroughPosesGoal(Message):
    """Where to go, one after the other, and by which behaviour tree, unless by the usual one."""

    poses: Sequence[PoseStamped] = ()
    behavior_tree: str = ""


@message("nav2_msgs/action/NavigateThroughPoses_Result")
class NavigateThroughPosesResult(Message):
    """Why it ended: 0 nothing is wrong, else one of Nav2's codes."""

    error_code: int = 0
    error_msg: str = ""


@message("nav2_msgs/action/NavigateThroughPoses_Feedback")
class NavigateThroughPosesFeedback(Message):
    """Where the robot is, how far it is from the last pose, m, and how many are left."""

    current_pose: PoseStamped = PoseStamped()
    navigation_time: Duration = Duration()
    estimated_time_remaining: Duration = Duration()
    number_of_recoveries: int = 0
    distance_remaining: float = 0.0
    number_of_poses_remaining: int = 0


MoveBase = ros1_action("move_base_msgs/action/MoveBase", MoveBaseGoal, MoveBaseResult, MoveBaseFeedback)
NavigateToPose = ros2_action(
    "nav2_msgs/action/NavigateToPose", NavigateToPoseGoal, NavigateToPoseResult, NavigateToPoseFeedback
)
NavigateThroughPoses = ros2_action(
    "nav2_msgs/action/NavigateThroughPoses",
    NavigateThroughPosesGoal,
    NavigateThroughPosesResult,
    NavigateThroughPosesFeedback,
)
