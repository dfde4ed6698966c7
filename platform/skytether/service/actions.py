"""An action server in a service: from its kind to the topics and calls that carry it, and the messages that come in."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from skytether.messages import (
    ActionlibGoalStatusArray,
    ActionType,
    CancelGoal,
    DecodeError,
    Encoding,
    GoalID,
    GoalStatusArray,
    Message,
    ServiceType,
    decode,
)

from .actionlib import ActionlibServer
from .goals import ActionServer
from .rcl_action import RclActionServer

MAX_INBOX = 256
"""Goals and cancellations that wait for the service's thread; more are dropped and counted."""

Handler = Callable[[Any], Any]


@dataclass(frozen=True, slots=True)
class Joined:
    """A server and what carries it, by topic or call.

    Attributes:
        inputs: Topics from the robot, and what handles their messages.
        outputs: Topics to the robot.
        calls: Calls of the robot, and what answers them.
    """

    server: ActionServer[Any, Any, Any]
    inputs: dict[str, tuple[type[Message], Handler]]
    outputs: dict[str, type[Message]]
    calls: dict[str, tuple[ServiceType[Any, Any], Handler]]


def join(action: ActionType[Any, Any, Any], name: str, epoch: float) -> Joined:
    """Make the server of an action of this name."""
    made = action.wrappers
    if action.kind == "action":
        ros1: ActionlibServer[Any, Any, Any] = ActionlibServer(action, name, epoch)
        inputs = {"goal": (made["ActionGoal"], ros1.on_goal), "cancel": (GoalID, ros1.on_cancel)}
        outputs = {"status": ActionlibGoalStatusArray, "result": made["ActionResult"]}
        return _named(name, Joined(ros1, inputs, {**outputs, "feedback": made["ActionFeedback"]}, {}))
    ros2: RclActionServer[Any, Any, Any] = RclActionServer(action, name, epoch)
    send, get = (
        ServiceType(f"{action.name}_{call}", made[f"{call}_Request"], made[f"{call}_Response"])
        for call in ("SendGoal", "GetResult")
    )
    calls: dict[str, tuple[ServiceType[Any, Any], Handler]] = {
        "send_goal": (send, ros2.on_send_goal),
        "cancel_goal": (CancelGoal, ros2.on_cancel_goal),
        "get_result": (get, ros2.on_get_result),
    }
    topics = {"feedback": made["FeedbackMessage"], "status": GoalStatusArray}
    return _named(f"{name}/_action", Joined(ros2, {}, topics, calls))


def _named(prefix: str, parts: Joined) -> Joined:
    """With whole names."""
    return Joined(
        parts.server,
        {f"{prefix}/{part}": what for part, what in parts.inputs.items()},
        {f"{prefix}/{part}": cls for part, cls in parts.outputs.items()},
        {f"{prefix}/{part}": what for part, what in parts.calls.items()},
    )


class Inbox:
    """Messages that all count, in the order of their arrival, until the service's thread has time for them."""

    def __init__(self, log: logging.Logger) -> None:
        self.dropped = 0
        """Because too many waited, or because they were no such message."""
        self._log = log
        self._waiting: deque[tuple[type[Message], Handler, bytes, Encoding]] = deque()

    def put(self, what: tuple[type[Message], Handler], payload: bytes | memoryview, encoding: Encoding) -> None:
        """From the bridge's thread."""
        if len(self._waiting) >= MAX_INBOX:
            self._drop(f"more than {MAX_INBOX} of them wait")
            return
        self._waiting.append((*what, bytes(payload), encoding))

    def work(self) -> None:
        """From the service's thread."""
        while self._waiting:
            cls, handle, payload, encoding = self._waiting.popleft()
            try:
                message = decode(cls, payload, encoding)
            except DecodeError as error:
                self._drop(str(error))
                continue
            handle(message)

    def _drop(self, why: str) -> None:
        self.dropped += 1
        if self.dropped == 1:
            self._log.warning("a goal or a cancellation was dropped, more are counted, not logged: %s", why)
