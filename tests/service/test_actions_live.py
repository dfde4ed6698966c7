"""Actions over real bridges: robots that come, go, and come again as somebody new."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import Any, Literal

import pytest

from skytether.api.manifest import TopicSpec
from skytether.bridge import Bridge, CallError, GraphPort, LocalGraph, SessionSpec, topics_from_api
from skytether.messages import (
    UUID,
    ActionlibGoalStatusArray,
    CancelGoalRequest,
    CancelGoalResponse,
    Encoding,
    GoalID,
    GoalInfo,
    GoalStatusArray,
    MoveBase,
    MoveBaseGoal,
    NavigateToPose,
    NavigateToPoseResult,
    decode,
    encode,
)
from skytether.service import Action, Goal, NoParams, Service
from skytether.service.clock import SystemClock
from skytether.service.loop import Loop
from skytether.service.port import ServicePort
from skytether.wire.topic import Role

pytestmark = pytest.mark.slow
KEY, PATIENCE_S = bytes(32), 30.0
OLD, NEW = MoveBase.wrappers, NavigateToPose.wrappers


class Go(Service[NoParams]):
    """Pursues every goal until told to reach it."""

    rate_hz = 50.0
    old = Action(MoveBase)
    new = Action(NavigateToPose)

    def start(self) -> None:
        self.reach = threading.Event()
        self.goals: list[Goal[Any, Any, Any]] = []

    def step(self, now: float) -> None:
        servers: list[Any] = [self.old, self.new]
        for goal in (goal for server in servers for goal in iter(server.take, None)):
            goal.accept()
            self.goals.append(goal)
        for goal in [goal for goal in self.goals if not goal.has_ended]:
            if goal.cancel_requested:
                goal.cancel()
            elif self.reach.is_set():
                goal.succeed(text="there")


def until(condition: Callable[[], Any]) -> Any:
    deadline = time.monotonic() + PATIENCE_S
    while not (found := condition()):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return found


def rows(kind: Literal["action", "ros2_action"]) -> list[TopicSpec]:
    name, action = ("old", MoveBase.name) if kind == "action" else ("new", NavigateToPose.name)
    encoding: Encoding = "ros1" if kind == "action" else "cdr"
    return [TopicSpec(name=name, kind=kind, type=action, direction="in", encoding=encoding)]


@contextmanager
def serving() -> Iterator[tuple[Go, tuple[str, int]]]:
    """The service, stepping in a thread of its own, and where robots find it."""
    service = Go(NoParams())
    service.start()
    with closing(SystemClock()) as clock:
        port = ServicePort(service, clock.wake)
        loop = Loop(service, port, clock, idle_exit=600.0)
        table = topics_from_api([*rows("action"), *rows("ros2_action")])
        with Bridge(SessionSpec(7, KEY, Role.SERVICE, table), port) as bridge:
            thread = threading.Thread(target=loop.run)
            thread.start()
            try:
                yield service, bridge.address
            finally:
                loop.stop()
                thread.join()
                port.close()


@contextmanager
def robot(
    address: tuple[str, int], kind: Literal["action", "ros2_action"]
) -> Iterator[tuple[Bridge, LocalGraph, dict[str, list[bytes]]]]:
    """A robot with the actions of one generation, and what it hears."""
    table = topics_from_api(rows(kind))
    graph, heard = LocalGraph(), {topic.name: list[bytes]() for topic in table}
    for name, got in heard.items():
        graph.subscribe(name, lambda payload, got=got: got.append(bytes(payload)))  # type: ignore[misc]
    port = GraphPort(graph, table, Role.ROBOT)
    with Bridge(SessionSpec(7, KEY, Role.ROBOT, table), port, peer=address) as bridge:
        until(lambda: bridge.stats().connected)
        yield bridge, graph, heard


def test_a_result_of_ros2_waits_for_the_robot_that_comes_again() -> None:
    which = UUID([5] * 16)
    get = encode(NEW["GetResult_Request"](which))

    def result(bridge: Bridge) -> Any:
        return decode(NEW["GetResult_Response"], bridge.call("new/_action/get_result", get, PATIENCE_S))

    def told(message: bytes) -> Any:
        return decode(GoalStatusArray, message).status_list

    with serving() as (service, address):
        with robot(address, "ros2_action") as (bridge, _, heard):
            sent = bridge.call("new/_action/send_goal", encode(NEW["SendGoal_Request"](which)), PATIENCE_S)
            assert decode(NEW["SendGoal_Response"], sent).accepted
            until(lambda: heard["new/_action/status"])
            with pytest.raises(CallError, match="no answer within"):  # it is asked for while the robot drives
                bridge.call("new/_action/get_result", get, 0.3)
        service.reach.set()
        until(lambda: service.goals[0].has_ended)
        with robot(address, "ros2_action") as (bridge, _, heard):
            until(lambda: [s.status for m in heard["new/_action/status"][-1:] for s in told(m)] == [4])
            assert (result(bridge).status, result(bridge).result) == (4, NavigateToPoseResult())


def test_a_goal_of_ros2_is_called_off_while_its_result_is_awaited() -> None:
    which = UUID([6] * 16)
    ended: list[Any] = []

    with serving() as (_, address), robot(address, "ros2_action") as (bridge, _, _):
        bridge.call("new/_action/send_goal", encode(NEW["SendGoal_Request"](which)), PATIENCE_S)
        request = encode(NEW["GetResult_Request"](which))
        waiting = threading.Thread(
            target=lambda: ended.append(bridge.call("new/_action/get_result", request, PATIENCE_S))
        )
        waiting.start()
        off = bridge.call("new/_action/cancel_goal", encode(CancelGoalRequest(GoalInfo(which))), PATIENCE_S)
        assert decode(CancelGoalResponse, off).return_code == 0
        waiting.join()
        assert decode(NEW["GetResult_Response"], ended[0]).status == 5


def test_a_result_of_ros1_is_told_the_robot_that_comes_again_once() -> None:
    with serving() as (service, address):
        with robot(address, "action") as (_, graph, heard):
            goal = OLD["ActionGoal"](goal_id=GoalID(id="a"), goal=MoveBaseGoal())
            graph.publish("old/goal", encode(goal, "ros1"))

            def active() -> bool:
                newest = heard["old/status"][-1:]
                told = [decode(ActionlibGoalStatusArray, m, "ros1").status_list for m in newest]
                return any(status.status == 1 for statuses in told for status in statuses)

            until(active)
        until(lambda: service.senders["old/status"].encoding is None)  # the goodbye has come
        service.reach.set()
        until(lambda: service.goals[0].has_ended)
        with robot(address, "action") as (_, _, heard):
            until(lambda: heard["old/result"])
            many = len(heard["old/status"])
            until(lambda: len(heard["old/status"]) > many + 2)
            (result,) = (decode(OLD["ActionResult"], told, "ros1") for told in heard["old/result"])
            assert (result.status.goal_id.id, result.status.status, result.status.text) == ("a", 3, "there")
