"""Calls of a service: declared as topics are, answered in the thread of the steps, made without blocking it."""

from __future__ import annotations

import logging
import threading
from concurrent.futures import Future

import pytest
import yaml
from patrol.service import Patrol
from tests.service.conftest import EXAMPLES, KEY, SESSION
from tests.service.test_process import wait_ready

from skytether.api.manifest import Manifest
from skytether.bridge import Bridge, SessionSpec, topics_from_api
from skytether.bridge import CallError as BridgeCallError
from skytether.messages import (
    GetMapRequest,
    GetMapResponse,
    OccupancyGrid,
    SetBool,
    SetBoolRequest,
    SetBoolResponse,
    Trigger,
    TriggerRequest,
    TriggerResponse,
    decode,
    encode,
)
from skytether.service import Call, CallError, NoParams, Service, answers
from skytether.service.loop import Loop
from skytether.service.port import ServicePort
from skytether.testing.service import FakeClock, Harness
from skytether.wire.topic import Role


class Both(Service[NoParams]):
    """Answers one call, makes another."""

    rate_hz = 10.0
    go = Call(Trigger, "robot/go")
    got: Future[TriggerResponse] | None = None
    threads: set[str]

    @answers(SetBool)
    def switch(self, request: SetBoolRequest) -> SetBoolResponse:
        if request.data:
            raise CallError("not now")
        return SetBoolResponse(True, threading.current_thread().name)

    def step(self, now: float) -> None:
        pass


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_a_call_of_the_robot_and_one_of_the_service(encoding) -> None:
    harness = Harness(Both, encoding=encoding)
    assert harness.call("switch", SetBoolRequest(False)) == SetBoolResponse(True, "MainThread")
    with pytest.raises(CallError, match="not now"):
        harness.call("switch", SetBoolRequest(True))
    harness.answers("robot/go", lambda request: TriggerResponse(True, "gone"))
    assert harness.service.go.ask(TriggerRequest()).result(0) == TriggerResponse(True, "gone")
    assert harness.service.switch(SetBoolRequest(False)).success  # a method like any other


def test_what_can_go_wrong_is_said() -> None:
    harness = Harness(Both)
    with pytest.raises(CallError, match=r"'robot/go': this robot answers none"):
        harness.service.go.ask(TriggerRequest()).result(0)
    with pytest.raises(TypeError, match="std_srvs/srv/Trigger_Request, not SetBoolRequest"):
        harness.service.go.ask(SetBoolRequest())
    harness.disconnect()
    with pytest.raises(CallError, match="no robot is there"):
        harness.service.go.ask(TriggerRequest()).result(0)
    waiting = harness.port.desk.ask("switch", b"nonsense", "cdr")
    harness.port.desk.work()
    with pytest.raises(CallError, match="are no std_srvs/srv/SetBool_Request"):
        waiting.result(0)
    waiting = harness.port.desk.ask("switch", b"", "cdr")
    harness.port.close()
    for late in (waiting, harness.port.desk.ask("switch", b"", "cdr")):
        with pytest.raises(CallError, match="the service ends"):
            late.result(0)


def test_a_handler_that_breaks_ends_the_service_and_the_robot_is_told() -> None:
    class Broken(Both):
        @answers(SetBool)
        def switch(self, request: SetBoolRequest) -> SetBoolResponse:
            raise ZeroDivisionError

    harness = Harness(Broken)
    waiting = harness.port.desk.ask("switch", encode(SetBoolRequest()), "cdr")
    with pytest.raises(ZeroDivisionError):
        harness.port.desk.work()
    with pytest.raises(CallError, match="its handler failed: ZeroDivisionError"):
        waiting.result(0)


def test_one_name_is_one_declaration() -> None:
    with pytest.raises(TypeError, match="topic 'switch' is declared twice"):
        type("Twice", (Both,), {"other": Call(Trigger, "switch")})


def test_calls_are_answered_between_steps_and_wake_who_sleeps() -> None:
    clock = FakeClock()
    service = Both(NoParams())
    port = ServicePort(service, clock.wake)
    loop = Loop(service, port, clock, 100.0)
    when: list[float] = []

    def ask() -> None:
        asked = port.desk.ask("switch", encode(SetBoolRequest()), "cdr")
        asked.add_done_callback(lambda _: when.append(clock.now()))

    clock.at(1000.95, ask)
    clock.at(1002.0, loop.stop)
    loop.run()
    assert when == [1000.95]
    assert loop.steps >= 19


def test_manifest_of_the_example() -> None:
    manifest = Manifest.model_validate(yaml.safe_load((EXAMPLES / "patrol" / "service.yaml").read_text()))
    assert {(t.name, t.kind, t.type, t.direction) for t in manifest.spec.topics} == {
        (d.topic, d.kind, d.type_name, d.direction.value) for d in Patrol.declared
    }


@pytest.mark.slow
def test_calls_both_ways_through_a_process(grant, spawn) -> None:
    rows = Manifest.model_validate(yaml.safe_load((EXAMPLES / "patrol" / "service.yaml").read_text())).spec.topics
    environment = grant(service="patrol", topics=[row.model_dump() for row in rows])
    child = spawn("patrol", environment)
    port = RobotGraph()
    with Bridge(SessionSpec(SESSION, KEY, Role.ROBOT, topics_from_api(rows)), port) as robot:
        asked = threading.Event()

        def get_map(request: bytes) -> bytes:
            decode(GetMapRequest, request)
            asked.set()
            return encode(GetMapResponse(OccupancyGrid(data=[0] * 10)))

        robot.answer("get_map", get_map)
        robot.set_peer("127.0.0.1", wait_ready(child, grant.ready)["port"])
        assert asked.wait(30)
        assert port.turning.wait(30)
        answer = decode(SetBoolResponse, robot.call("pause", encode(SetBoolRequest(True)), 30.0))
        assert answer.success
        with pytest.raises(BridgeCallError, match="are no std_srvs/srv/SetBool_Request"):
            robot.call("pause", b"nonsense", 30.0)
    child.terminate()
    _, stderr = child.communicate(timeout=30)
    assert child.returncode == 0, stderr
    assert "Traceback" not in stderr


class RobotGraph:
    """Waits for the first velocity."""

    def __init__(self) -> None:
        self.turning = threading.Event()

    def attach(self, publisher: object) -> None:
        pass

    def deliver(self, message: object) -> None:
        self.turning.set()

    def notify(self, event: object) -> None:
        logging.getLogger(__name__).info("%s", event)
