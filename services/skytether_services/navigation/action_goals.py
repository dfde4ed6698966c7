"""Goals by which users of ROS know a navigation: the actions of move_base and of Nav2, told to the `Navigator`.

One goal is pursued at a time, of whichever action; a newer one takes its place, and so does one that comes by a topic.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skytether.messages import (
    Duration,
    Message,
    MoveBaseFeedback,
    MoveBaseGoal,
    MoveBaseResult,
    NavigateThroughPosesFeedback,
    NavigateThroughPosesGoal,
    NavigateThroughPosesResult,
    NavigateToPoseFeedback,
    NavigateToPoseResult,
    PoseStamped,
)
from skytether.service import ActionServer, Goal, Rate
from skytether_services.planar.geometry import Pose

from . import conversions as convert
from .navigator import Navigator
from .status import Code, State, Trouble
from .task import refusal

FEEDBACK_HZ = 5.0
_NAV2_CODES = {
    Code.GOAL_OFF_MAP: 204,
    Code.GOAL_BLOCKED: 206,
    Code.START_OFF_MAP: 203,
    Code.START_BLOCKED: 205,
    Code.NO_PATH: 208,
    Code.STUCK: 105,
    Code.BLOCKED: 106,
}
"""Those of ComputePathToPose (200 and more) and FollowPath (100 and more), which Nav2 hands on (nav2_msgs, Jazzy)."""
_UNKNOWN = 9000
_SOMEBODY = "Somebody gave the robot another goal."
_CALLED_OFF = "The goal was called off."


class ActionGoals:
    """Of one service.

    Args:
        servers: Of all its actions.
        top_speed: [m/s], by which the time that is left is reckoned.
        report: Tells people why a goal was refused: code and sentence. (ROS 2 has no way to tell the client.)
    """

    def __init__(
        self,
        servers: Sequence[ActionServer[Any, Any, Any]],
        top_speed: float,
        report: Callable[[str, str], None],
    ) -> None:
        self._servers = servers
        self._top_speed = top_speed
        self._report = report
        self._goal: Goal[Any, Any, Any] | None = None
        self._number = 0
        self._began = 0.0
        self._due = Rate(FEEDBACK_HZ)

    def refuse(self, sentence: str) -> None:
        """Nobody drives: every goal is refused, for this reason."""
        for goal in self._new():
            self._reject(goal, Trouble(Code.BAD_GOAL, sentence))

    def listen(self, navigator: Navigator, now: float) -> None:
        """Hand on what clients ask for; before the navigator's step."""
        for goal in self._new():
            wrong = _wrong(goal.message)
            if wrong is not None:
                self._reject(goal, wrong)
                continue
            self._superseded(navigator)
            self._end("cancel", 0, "A newer goal has come.")
            poses = [convert.pose_of(stamped.pose) for stamped in _poses(goal.message)]
            navigator.go(poses, stop_at_each=False)
            goal.accept()
            self._goal, self._number, self._began = goal, navigator.requests, now
        self._superseded(navigator)
        if self._goal is not None and self._goal.cancel_requested:
            navigator.cancel()
            self._end("cancel", 0, _CALLED_OFF)

    def update_client(self, navigator: Navigator, now: float, stamp: float) -> None:
        """Tell the client how its goal goes, or has ended; after the navigator's step.

        Args:
            navigator: Whose goal it is.
            now: [s].
            stamp: Of the newest odometry, by the robot's clock [s].
        """
        if self._goal is None:
            return
        report = navigator.report()
        match report.doing:
            case State.SUCCEEDED:
                self._end("succeed", 0, report.message)
            case State.FAILED:
                code = report.trouble.code if report.trouble is not None else Code.GAVE_UP
                self._end("abort", next((n for c, n in _NAV2_CODES.items() if c == code), _UNKNOWN), report.message)
            case State.CANCELED:
                self._end("cancel", 0, _CALLED_OFF)
            case _:
                if self._due.due(now):
                    self._feedback(navigator, now, stamp)

    def _new(self) -> list[Goal[Any, Any, Any]]:
        return [goal for server in self._servers for goal in iter(server.take, None)]

    def _reject(self, goal: Goal[Any, Any, Any], why: Trouble) -> None:
        goal.reject(why.message)
        self._report(str(why.code), why.message)

    def _superseded(self, navigator: Navigator) -> None:
        if navigator.requests != self._number:
            self._end("cancel", 0, _SOMEBODY)

    def _end(self, how: str, code: int, sentence: str) -> None:
        goal, self._goal = self._goal, None
        if goal is None:
            return
        result = _result(goal.message, code, sentence if code or how != "succeed" else "")
        {"succeed": goal.succeed, "abort": goal.abort, "cancel": goal.cancel}[how](result, sentence)

    def _feedback(self, navigator: Navigator, now: float, stamp: float) -> None:
        goal, report, state = self._goal, navigator.report(), navigator.whereabouts.state()
        if goal is None or report.task is None or state is None or navigator.whereabouts.estimate is None:
            return
        pose = convert.pose_stamped(state.pose, stamp)
        if isinstance(goal.message, MoveBaseGoal):
            goal.feedback(MoveBaseFeedback(pose))
            return
        ahead = report.task.goals[report.task.index :]
        left = way_left(report.left, navigator.path, state.pose, ahead)
        took, to_come = Duration.from_seconds(now - self._began), Duration.from_seconds(left / self._top_speed)
        told = pose, took, to_come, report.recoveries, left
        if isinstance(goal.message, NavigateThroughPosesGoal):
            goal.feedback(NavigateThroughPosesFeedback(*told, len(ahead)))
        else:
            goal.feedback(NavigateToPoseFeedback(*told))


def way_left(along: float, path: NDArray[np.float64], pose: Pose, goals: Sequence[Pose]) -> float:
    """How far it is to the last of the goals [m]: along the path as far as that leads, then straight from goal to goal.

    Args:
        along: What is left of the path [m]; NaN: there is none.
        path: Poses, n by 3; it may lead through several goals.
        pose: The robot's.
        goals: The present one and those after it.
    """
    if not len(path) or not math.isfinite(along):
        return sum(math.dist(a[:2], b[:2]) for a, b in pairwise((pose, *goals)))
    leads_to = min(range(len(goals)), key=lambda i: math.dist(path[-1, :2], goals[i][:2]))
    return along + sum(math.dist(a[:2], b[:2]) for a, b in pairwise(goals[leads_to:]))


def _poses(message: Any) -> Sequence[PoseStamped]:
    if isinstance(message, NavigateThroughPosesGoal):
        return message.poses
    return (message.target_pose if isinstance(message, MoveBaseGoal) else message.pose,)


def _wrong(message: Any) -> Trouble | None:
    """Why a goal cannot be one, whatever the map."""
    if getattr(message, "behavior_tree", ""):
        return Trouble(Code.BAD_GOAL, "A goal names a behaviour tree; give yours by the parameter behaviours.")
    stamped = _poses(message)
    for frame in (pose.header.frame_id for pose in stamped):
        if not convert.is_map(frame):
            return Trouble(Code.BAD_GOAL, convert.other_frame(frame))
    return refusal([convert.pose_of(pose.pose) for pose in stamped])


def _result(message: Any, code: int, sentence: str) -> Message:
    if isinstance(message, MoveBaseGoal):
        return MoveBaseResult()
    kind = NavigateThroughPosesResult if isinstance(message, NavigateThroughPosesGoal) else NavigateToPoseResult
    return kind(code, sentence)
