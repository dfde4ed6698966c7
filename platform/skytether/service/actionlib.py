"""An action server of ROS 1: five topics, as ``actionlib/action_server.py`` of Noetic serves them."""

from __future__ import annotations

from collections import deque
from typing import Any

from skytether.messages import ActionlibGoalStatus, ActionlibGoalStatusArray, GoalID, Header, Message, Time

from .goals import ActionServer, F, G, Goal, R, State

STATUS_PERIOD = 0.2
"""s between two status messages."""
STATUS_KEEP = 5.0
"""s that a goal stays in them after its end, counted from when its result was handed to the bridge."""
MAX_RESULTS = 64
"""Results that wait for a robot; beyond it the oldest are dropped."""
_CALLED_OFF = "Its time is not after that of a cancellation."
_ZERO = (0, 0)


class ActionlibServer(ActionServer[G, R, F]):
    """See the module; the bridge carries results reliably, what waits here waits for a robot to connect."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._made: int = 0
        self._last_cancel = _ZERO
        self._next_status = 0.0
        self._results: deque[tuple[Goal[G, R, F], Message]] = deque()

    def tick(self, now: float) -> None:
        super().tick(now)
        if self._send_results() or now >= self._next_status:
            self._publish_status()

    def due(self) -> float:
        return self._next_status

    def on_goal(self, message: Any) -> None:
        """A client's ActionGoal."""
        self._receive_goal(message.goal_id, message.goal)

    def on_cancel(self, which: GoalID) -> None:
        """A client's GoalID: an empty id without a time means all; else the one of that id, and all up to then.

        One that is not known is called off when it comes.
        """
        stamp = _order(which.stamp)
        for goal in list(self.goals.values()):
            everything = not which.id and stamp == _ZERO
            if everything or which.id == goal.id or (stamp != _ZERO and _order(goal.stamp) <= stamp):
                self._ask_to_cancel(goal)
        if which.id and which.id not in self.goals:
            unseen = Goal(self, which.id, which.stamp, self.action.goal())
            unseen.state, unseen.ended_at = State.RECALLING, self.now
            self.goals[which.id] = unseen
        self._last_cancel = max(self._last_cancel, stamp)
        self._publish_status()

    def accepted(self, goal: Goal[G, R, F]) -> None:  # noqa: ARG002 - all goals are told of
        self._publish_status()

    def publish_feedback(self, goal: Goal[G, R, F], feedback: F) -> bool:
        cls = self.action.wrappers["ActionFeedback"]
        return self.send("feedback", cls(Header(self.unix_time), _status(goal), feedback))

    def ended(self, goal: Goal[G, R, F], result: R) -> None:
        goal.ended_at = None  # an unseen goal that was called off had one
        cls = self.action.wrappers["ActionResult"]
        if len(self._results) >= MAX_RESULTS:
            self._results.popleft()[0].ended_at = self.now
        self._results.append((goal, cls(Header(self.unix_time), _status(goal), result)))
        self._send_results()
        self._publish_status()

    def _receive_goal(self, goal_id: GoalID, message: G) -> None:
        known = self.goals.get(goal_id.id)
        if known is not None:
            if known.state is State.RECALLING:
                known.cancel(text="It was called off before it came.")
            elif known.ended_at is not None:
                known.ended_at = self.now
            return
        stamp = goal_id.stamp if _order(goal_id.stamp) != _ZERO else self.unix_time
        self._made += not goal_id.id
        made = f"{self.name}-{self._made}-{stamp.sec}.{stamp.nanosec:09}"
        goal = Goal(self, goal_id.id or made, stamp, message)
        self.goals[goal.id] = goal
        if _ZERO != _order(goal_id.stamp) <= self._last_cancel:
            goal.cancel(text=_CALLED_OFF)
        else:
            self._offer(goal)
            self._publish_status()

    def _send_results(self) -> bool:
        """Whether there were any that somebody takes."""
        waiting = len(self._results)
        while self._results and self.send("result", self._results[0][1]):
            self._results.popleft()[0].ended_at = self.now
        return len(self._results) < waiting

    def _publish_status(self) -> None:
        self._forget(STATUS_KEEP)
        self._next_status = self.now + STATUS_PERIOD
        self.send("status", ActionlibGoalStatusArray(Header(self.unix_time), [*map(_status, self.goals.values())]))


def _status(goal: Goal[Any, Any, Any]) -> ActionlibGoalStatus:
    return ActionlibGoalStatus(GoalID(goal.stamp, goal.id), goal.state, goal.text)


def _order(time: Time) -> tuple[int, int]:
    return time.sec, time.nanosec
