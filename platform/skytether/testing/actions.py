"""A robot's client of an action, for tests of a service by its `Harness`: of ROS 1 or ROS 2, as the robot speaks.

harness = Harness(Go, encoding="ros1")
client = ActionClient(harness, "move_base")
goal = client.send(MoveBaseGoal(...))
harness.step()
assert client.state(goal) == "active"
"""

from __future__ import annotations

from concurrent.futures import Future
from typing import Any

import numpy as np

from skytether.messages import UUID, CancelGoalRequest, GoalID, GoalInfo, Message, Time
from skytether.service import ActionServer, CallError
from skytether.service.goals import State
from skytether.service.rcl_action import CODES

from .service import Harness

_ROS2 = {code: state.name.lower() for state, code in CODES.items()}


class ActionClient:
    """Sends goals and remembers what became of them, by the goal's id.

    Args:
        harness: With the service and the robot.
        name: Of the action.
    """

    def __init__(self, harness: Harness[Any], name: str) -> None:
        self._harness = harness
        self._name = name
        servers: list[ActionServer[Any, Any, Any]] = harness.service.actions
        self._made = next(server.action.wrappers for server in servers if server.name == name)
        self._is_ros1 = harness.encoding == "ros1"
        self._sent = 0
        self._decisions: dict[str, Future[Any]] = {}
        self._results: dict[str, Future[Any]] = {}

    def send(self, goal: Message, goal_id: str = "", stamp: float = 0.0) -> str:
        """Send a goal; gives its id, which is made up unless given."""
        self._sent += 1
        if self._is_ros1:
            goal_id = goal_id or f"goal {self._sent}"
            which = GoalID(Time.from_seconds(stamp), goal_id)
            self._harness.send(f"{self._name}/goal", self._made["ActionGoal"](goal_id=which, goal=goal))
            return goal_id
        goal_id = goal_id or f"{self._sent:032x}"
        request = self._made["SendGoal_Request"](_uuid(goal_id), goal)
        self._decisions[goal_id] = self._harness.ask(f"{self._name}/_action/send_goal", request)
        return goal_id

    def ask_result(self, goal_id: str) -> Future[Any]:
        """Wait for the end of a goal, as a client of ROS 2 does once it is accepted; `end` does it where it was not."""
        request = self._made["GetResult_Request"](_uuid(goal_id))
        asked = self._results[goal_id] = self._harness.ask(f"{self._name}/_action/get_result", request)
        return asked

    def cancel(self, goal_id: str = "", stamp: float = 0.0) -> int:
        """Call off one goal, all up to a time [Unix time, s], or without either all; gives ROS 2's return code."""
        time = Time.from_seconds(stamp)
        if self._is_ros1:
            self._harness.send(f"{self._name}/cancel", GoalID(time, goal_id))
            return 0
        request = CancelGoalRequest(GoalInfo(_uuid(goal_id or "00" * 16), time))
        return int(self._harness.call(f"{self._name}/_action/cancel_goal", request).return_code)

    def is_accepted(self, goal_id: str) -> bool | None:
        """What the service decided, in ROS 2; None: nothing yet."""
        decision = self._decisions[goal_id]
        return bool(decision.result().accepted) if decision.done() else None

    def states(self) -> dict[str, str]:
        """What the newest status says, by goal: actionlib's words in lower case, for both generations."""
        if self._is_ros1:
            newest = self._harness.newest(f"{self._name}/status")
            return {s.goal_id.id: State(s.status).name.lower() for s in newest.status_list} if newest else {}
        newest = self._harness.newest(f"{self._name}/_action/status")
        told = newest.status_list if newest else ()
        return {s.goal_info.goal_id.uuid.tobytes().hex(): _ROS2[s.status] for s in told}

    def state(self, goal_id: str) -> str | None:
        """Of one goal; None: it is not there any more."""
        return self.states().get(goal_id)

    def feedback(self, goal_id: str) -> list[Any]:
        """All that was told of a goal so far."""
        if self._is_ros1:
            messages = self._harness.outputs[f"{self._name}/feedback"]
            return [m.feedback for m in messages if m.status.goal_id.id == goal_id]  # type: ignore[attr-defined]
        messages = self._harness.outputs[f"{self._name}/_action/feedback"]
        return [m.feedback for m in messages if m.goal_id.uuid.tobytes().hex() == goal_id]  # type: ignore[attr-defined]

    def end(self, goal_id: str) -> tuple[str, str, Any] | None:
        """State, text (ROS 1) and result of a goal that has ended; None: it has not."""
        if self._is_ros1:
            results: list[Any] = self._harness.outputs[f"{self._name}/result"]
            found = [m for m in results if m.status.goal_id.id == goal_id]
            if len(found) > 1:
                raise AssertionError(f"{goal_id} has {len(found)} results")
            return (
                (State(found[0].status.status).name.lower(), found[0].status.text, found[0].result) if found else None
            )
        if goal_id not in self._results:
            if not self.is_accepted(goal_id):
                return None if self.is_accepted(goal_id) is None else ("rejected", "", None)
            self.ask_result(goal_id)
        asked = self._results[goal_id]
        if not asked.done():
            return None
        try:
            answer = asked.result()
        except CallError as error:
            return "failed", str(error), None
        return _ROS2.get(answer.status, "unknown"), "", answer.result


def _uuid(goal_id: str) -> UUID:
    return UUID(np.frombuffer(bytes.fromhex(goal_id), np.uint8))
