"""Goals of an action server, and what may become of them: the part that ROS 1 and ROS 2 have in common. Pure.

The states are those of actionlib (wiki.ros.org/actionlib/DetailedDescription, and ``server_goal_handle.py``). Those of
ROS 2 (design.ros2.org/articles/actions.html, and ``goal_state_machine.c``) are the same without the ones before a goal
is accepted, under other names.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from enum import IntEnum
from typing import Any, Generic, TypeVar

from skytether.messages import ActionType, Message, Time

G = TypeVar("G", bound=Message)
R = TypeVar("R", bound=Message)
F = TypeVar("F", bound=Message)

MAX_WAITING = 64
"""Goals that the service has not looked at yet; more are rejected."""
MAX_ENDED = 100
"""Goals that have ended and are remembered; beyond it the oldest are forgotten."""
_TOO_MANY = f"{MAX_WAITING} goals wait already"


class State(IntEnum):
    """By actionlib's numbers."""

    PENDING = 0
    ACTIVE = 1
    PREEMPTED = 2
    SUCCEEDED = 3
    ABORTED = 4
    REJECTED = 5
    PREEMPTING = 6
    RECALLING = 7
    RECALLED = 8


MOVES = {
    "accept": {State.PENDING: State.ACTIVE, State.RECALLING: State.PREEMPTING},
    "reject": {State.PENDING: State.REJECTED, State.RECALLING: State.REJECTED},
    "ask to cancel": {State.PENDING: State.RECALLING, State.ACTIVE: State.PREEMPTING},
    "succeed": {State.ACTIVE: State.SUCCEEDED, State.PREEMPTING: State.SUCCEEDED},
    "abort": {State.ACTIVE: State.ABORTED, State.PREEMPTING: State.ABORTED},
    "cancel": {
        State.PENDING: State.RECALLED,
        State.RECALLING: State.RECALLED,
        State.ACTIVE: State.PREEMPTED,
        State.PREEMPTING: State.PREEMPTED,
    },
}
"""From state to state; all else is a mistake of whoever asks for it."""
ENDS = (State.PREEMPTED, State.SUCCEEDED, State.ABORTED, State.REJECTED, State.RECALLED)


class GoalError(Exception):
    """A goal cannot become that any more, or not yet. Nothing has changed."""


class Goal(Generic[G, R, F]):
    """What one client asks for. A service gets it pending, accepts or rejects it, and ends it: once each.

    Attributes:
        id: Of the client; in ROS 2 32 hexadecimal digits.
        stamp: Of the client in ROS 1; in ROS 2 of its acceptance.
        message: What is asked for.
        state: How far it has come.
        text: What was said of that last.
        ended_at: s of the monotonic clock; None while it has not.
    """

    def __init__(self, server: ActionServer[G, R, F], goal_id: str, stamp: Time, message: G) -> None:
        self.id = goal_id
        self.stamp = stamp
        self.message = message
        self.state = State.PENDING
        self.text = ""
        self.ended_at: float | None = None
        self._server = server

    @property
    def has_ended(self) -> bool:
        """Whether nothing more can become of it."""
        return self.state in ENDS

    @property
    def cancel_requested(self) -> bool:
        """Whether the client wants it to be called off; the service ends it with `cancel`, or as it likes."""
        return self.state in (State.PREEMPTING, State.RECALLING)

    def accept(self, text: str = "") -> None:
        """It is pursued from now on.

        Raises:
            GoalError: That was decided already.
        """
        self.move("accept", text)
        self._server.accepted(self)

    def reject(self, text: str = "") -> None:
        """It is not pursued. The text reaches clients of ROS 1; those of ROS 2 are told no reason.

        Raises:
            GoalError: It was accepted, or has ended.
        """
        self._end("reject", None, text)

    def feedback(self, feedback: F) -> bool:
        """Tell how it goes.

        Returns:
            False if no robot is connected that wants to know.

        Raises:
            GoalError: It is not pursued.
        """
        if self.state not in (State.ACTIVE, State.PREEMPTING):
            raise GoalError(f"goal {self.id} is {self.state.name.lower()}: there is nothing to tell of it")
        return self._server.publish_feedback(self, feedback)

    def succeed(self, result: R | None = None, text: str = "") -> None:
        """It is reached.

        Raises:
            GoalError: It is not pursued.
        """
        self._end("succeed", result, text)

    def abort(self, result: R | None = None, text: str = "") -> None:
        """It is given up.

        Raises:
            GoalError: It is not pursued.
        """
        self._end("abort", result, text)

    def cancel(self, result: R | None = None, text: str = "") -> None:
        """It is called off: by the client, or for something newer.

        In ROS 2 the latter is an abort, as in Nav2: a goal is canceled there only if its client asked for it.

        Raises:
            GoalError: It has ended.
        """
        unasked = self.state is State.ACTIVE and not self._server.cancels_unasked
        self._end("abort" if unasked else "cancel", result, text)

    def move(self, what: str, text: str) -> None:
        """Only the state; for `ActionServer`.

        Raises:
            GoalError: See `MOVES`.
        """
        following = MOVES[what].get(self.state)
        if following is None:
            raise GoalError(f"goal {self.id} is {self.state.name.lower()}: it cannot {what} any more, or not yet")
        self.state, self.text = following, text

    def _end(self, what: str, result: R | None, text: str) -> None:
        kind = self._server.action.result
        if result is not None and type(result) is not kind:
            raise TypeError(f"action {self._server.action.name} ends with {kind.TYPE}, not {type(result).__name__}")
        self.move(what, text)
        self._server.forget_waiting(self)
        self._server.ended(self, kind() if result is None else result)


class ActionServer(Generic[G, R, F]):
    """Goals that the robot's clients send: what stands behind an `Action` in a service.

    Attributes:
        action: Its kind.
        name: Of the action.
        now: s of the monotonic clock, as of the last `tick`.
        send: Hands a message to the bridge by part and message; False if nobody takes it. Set by the service.

    Args:
        epoch: Unix time at which the monotonic clock stood at 0.
    """

    cancels_unasked = True
    """Whether a goal that is pursued may be canceled although no client asked for it."""

    def __init__(self, action: ActionType[G, R, F], name: str, epoch: float = 0.0) -> None:
        self.action = action
        self.name = name
        self.now = 0.0
        self.send: Callable[[str, Any], bool] = lambda _, __: False
        self.goals: dict[str, Goal[G, R, F]] = {}
        self._waiting: deque[Goal[G, R, F]] = deque()
        self._epoch = epoch

    def take(self) -> Goal[G, R, F] | None:
        """The oldest goal that was not taken yet: accept or reject it. None if there is none."""
        return self._waiting.popleft() if self._waiting else None

    @property
    def unix_time(self) -> Time:
        """Of `now`."""
        return Time.from_seconds(self._epoch + self.now)

    def tick(self, now: float) -> None:
        """Time has passed; before each step, and by `due` at the latest."""
        self.now = now

    def due(self) -> float:
        """When `tick` has something to do [s of the monotonic clock]."""
        raise NotImplementedError

    def renew(self) -> None:
        """A robot has connected, maybe another one. From the bridge's thread."""

    def accepted(self, goal: Goal[G, R, F]) -> None:
        """See `Goal.accept`."""

    def publish_feedback(self, goal: Goal[G, R, F], feedback: F) -> bool:
        """See `Goal.feedback`."""
        raise NotImplementedError

    def ended(self, goal: Goal[G, R, F], result: R) -> None:
        """See `Goal.succeed` and the like."""
        raise NotImplementedError

    def forget_waiting(self, goal: Goal[G, R, F]) -> None:
        """It needs no look any more."""
        if goal in self._waiting:
            self._waiting.remove(goal)

    def _offer(self, goal: Goal[G, R, F]) -> None:
        """Have the service look at it."""
        if len(self._waiting) < MAX_WAITING:
            self._waiting.append(goal)
        else:
            goal.reject(_TOO_MANY)

    def _ask_to_cancel(self, goal: Goal[G, R, F]) -> bool:
        """A client wants that. What the service has not looked at is called off at once."""
        if goal.state not in MOVES["ask to cancel"]:
            return False
        goal.move("ask to cancel", goal.text)
        if goal in self._waiting:
            goal.cancel(text="It was called off before it was looked at.")
        return True

    def _forget(self, keep_s: float) -> bool:
        """Drop goals that ended long ago, or too many; whether there were any."""
        ended = sorted((g.ended_at, g.id) for g in self.goals.values() if g.ended_at is not None)
        old = [i for n, (at, i) in enumerate(ended) if self.now - at > keep_s or len(ended) - n > MAX_ENDED]
        for goal_id in old:
            del self.goals[goal_id]
        return bool(old)
