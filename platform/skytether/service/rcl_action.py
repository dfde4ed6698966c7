"""An action server of ROS 2: three calls and two topics, as ``rcl_action/action_server.c`` and rclcpp_action do it."""

from __future__ import annotations

from collections import defaultdict
from concurrent.futures import Future
from typing import Any

import numpy as np

from skytether.messages import UUID, CancelGoalRequest, CancelGoalResponse, GoalInfo, GoalStatus, GoalStatusArray, Time

from .errors import CallError
from .goals import ActionServer, F, G, Goal, R, State

RESULT_KEEP = 900.0
"""s that a result is kept: the default of rcl until Iron; the 10 s of later ones are few for a lost link."""
MAX_ASKED = 4
"""Requests for one result that may wait; with more the oldest fails, so that none takes the place of other calls."""
CODES = {
    State.ACTIVE: 2,
    State.PREEMPTING: 3,
    State.SUCCEEDED: 4,
    State.PREEMPTED: 5,
    State.ABORTED: 6,
}
"""Of action_msgs/msg/GoalStatus; what was not accepted has none."""
_NONE, _UNKNOWN_GOAL, _TERMINATED = 0, 2, 3
"""Return codes of a cancellation."""
_ALL = "00" * 16


class RclActionServer(ActionServer[G, R, F]):
    """See the module. A goal that is accepted is executing at once."""

    cancels_unasked = False

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._untold = True
        self._decisions: dict[str, Future[Any]] = {}
        self._results: dict[str, Any] = {}
        self._asked: defaultdict[str, list[Future[Any]]] = defaultdict(list)

    def tick(self, now: float) -> None:
        super().tick(now)
        if self._forget(RESULT_KEEP):
            self._results = {i: result for i, result in self._results.items() if i in self.goals}
            self._untold = True
        self._publish_status()

    def due(self) -> float:
        return min((g.ended_at + RESULT_KEEP for g in self.goals.values() if g.ended_at is not None), default=np.inf)

    def renew(self) -> None:
        self._untold = True

    def on_send_goal(self, request: Any) -> Future[Any]:
        """A client's goal; answered when the service has decided."""
        decision: Future[Any] = Future()
        goal = Goal(self, _hex(request.goal_id), Time(), request.goal)
        if goal.id in self.goals or goal.id in self._decisions:
            decision.set_result(self.action.wrappers["SendGoal_Response"]())
        else:
            self._decisions[goal.id] = decision
            self._offer(goal)
        return decision

    def on_cancel_goal(self, request: CancelGoalRequest) -> CancelGoalResponse:
        """Zeros are all goals; an id without a time that one; a time all up to it, and the one of the id."""
        which, stamp = _hex(request.goal_info.goal_id), _order(request.goal_info.stamp)
        if which != _ALL and request.goal_info.stamp == Time():
            goal = self.goals.get(which)
            if goal is None:
                return CancelGoalResponse(_UNKNOWN_GOAL)
            if not self._ask_to_cancel(goal):
                return CancelGoalResponse(_TERMINATED)
            meant = [goal]
        else:
            up_to = (np.inf, 0) if stamp == (0, 0) else stamp
            candidates = [g for g in self.goals.values() if g.id == which or _order(g.stamp) <= up_to]
            meant = [goal for goal in candidates if self._ask_to_cancel(goal)]
        self._untold = self._untold or bool(meant)
        self._publish_status()
        return CancelGoalResponse(_NONE, [_info(goal) for goal in meant])

    def on_get_result(self, request: Any) -> Future[Any]:
        """A client waits for a goal's end."""
        goal_id, result = _hex(request.goal_id), Future[Any]()
        if goal_id not in self.goals:
            result.set_result(self.action.wrappers["GetResult_Response"]())  # status: unknown
        elif goal_id in self._results:
            result.set_result(self._results[goal_id])
        else:
            asked = self._asked[goal_id]
            asked.append(result)
            if len(asked) > MAX_ASKED:
                asked.pop(0).set_exception(CallError("the result was asked for again"))
        return result

    def accepted(self, goal: Goal[G, R, F]) -> None:
        goal.stamp = self.unix_time
        self.goals[goal.id] = goal
        self._decisions.pop(goal.id).set_result(self.action.wrappers["SendGoal_Response"](True, goal.stamp))
        self._changed()

    def publish_feedback(self, goal: Goal[G, R, F], feedback: F) -> bool:
        return self.send("feedback", self.action.wrappers["FeedbackMessage"](_uuid(goal), feedback))

    def ended(self, goal: Goal[G, R, F], result: R) -> None:
        decision = self._decisions.pop(goal.id, None)
        if decision is not None:  # not accepted: nobody hears of it again
            decision.set_result(self.action.wrappers["SendGoal_Response"]())
            return
        goal.ended_at = self.now
        response = self.action.wrappers["GetResult_Response"](CODES[goal.state], result)
        self._results[goal.id] = response
        for asked in self._asked.pop(goal.id, ()):
            asked.set_result(response)
        self._changed()

    def _changed(self) -> None:
        self._untold = True
        self._publish_status()

    def _publish_status(self) -> None:
        """The newest of this topic is kept for whoever comes later, so it is sent only when it changes."""
        if self._untold:
            told = [GoalStatus(_info(goal), CODES[goal.state]) for goal in self.goals.values()]
            self._untold = not self.send("status", GoalStatusArray(told))


def _hex(which: UUID) -> str:
    return which.uuid.tobytes().hex()


def _uuid(goal: Goal[Any, Any, Any]) -> UUID:
    return UUID(np.frombuffer(bytes.fromhex(goal.id), np.uint8))


def _info(goal: Goal[Any, Any, Any]) -> GoalInfo:
    return GoalInfo(_uuid(goal), goal.stamp)


def _order(time: Time) -> tuple[float, int]:
    return time.sec, time.nanosec
