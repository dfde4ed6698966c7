"""Request and response between two bridges on the loopback interface."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from skytether.api.manifest import TopicSpec
from skytether.bridge import CallError, CallFailedError, CallTimeoutError, calls, topics_from_api
from skytether.bridge.datagrams import DatagramSocket
from skytether.wire.topic import Role

TOPICS = topics_from_api(
    [
        TopicSpec(name="plan", kind="call", type="nav_msgs/srv/GetPlan", direction="in"),
        TopicSpec(name="stop", kind="call", type="std_srvs/srv/Trigger", direction="out"),
    ]
)


def test_a_call_is_a_pair_of_reliable_topics():
    assert [(t.name, t.type, t.direction.value, t.reliable, t.depth, t.lifespan) for t in TOPICS[:2]] == [
        ("plan/request", "nav_msgs/srv/GetPlan_Request", "in", True, 64, 60),
        ("plan/response", "nav_msgs/srv/GetPlan_Response", "out", True, 64, 60),
    ]


@pytest.mark.parametrize("wrong", [{"reliable": False}, {"latched": True}, {"name": "*"}])
def test_what_no_call_can_be_is_refused(wrong):
    with pytest.raises(ValueError, match="call"):
        TopicSpec(**{"name": "plan", "kind": "call", "type": "a/srv/B", "direction": "in", **wrong})


def test_calls_go_both_ways_and_many_at_a_time(ends):
    service, robot = ends.pair(topics=TOPICS)
    service.answer("plan", lambda request: request[::-1])
    robot.answer("stop", lambda request: b"stopped " + request)
    assert service.call("stop", b"now", 5) == b"stopped now"
    payloads = [b"%d" % i * (i * 100) for i in range(100)]
    with ThreadPoolExecutor(20) as pool:
        answers = list(pool.map(lambda p: robot.call("plan", p, 10), payloads))
    assert answers == [p[::-1] for p in payloads]
    assert not robot.graph.messages
    assert not service.graph.messages


def test_a_call_waits_for_the_session(ends):
    service = ends.start(Role.SERVICE, topics=TOPICS)
    service.answer("plan", bytes)
    robot = ends.start(Role.ROBOT, topics=TOPICS)
    with ThreadPoolExecutor(1) as pool:
        answer = pool.submit(robot.call, "plan", b"early", 10)
        robot.set_peer(*service.address)
        assert answer.result() == b"early"


def test_failures_are_told_in_a_sentence(ends):
    service, robot = ends.pair(topics=TOPICS)
    with pytest.raises(CallFailedError, match="call 'plan': nobody answers it at the other end"):
        robot.call("plan", b"", 5)

    def refuse(request):
        raise CallError("the goal lies in a wall")

    service.answer("plan", refuse)
    with pytest.raises(CallFailedError, match="call 'plan': the goal lies in a wall"):
        robot.call("plan", b"", 5)
    service.answer("plan", lambda request: 1 / 0)
    with pytest.raises(CallFailedError, match="call 'plan': its handler failed: ZeroDivisionError"):
        robot.call("plan", b"", 5)
    service.answer("plan", lambda request: bytes(17 * 2**20))
    with pytest.raises(CallFailedError, match="more than a message may have"):
        robot.call("plan", b"", 5)


def test_large_calls_that_wait_fill_no_memory(ends, monkeypatch):
    monkeypatch.setattr(calls, "MAX_WORKING_BYTES", 1_000_000)
    service, robot = ends.pair(topics=TOPICS)
    go, at_work = threading.Event(), threading.Semaphore(0)
    service.answer("plan", lambda request: (at_work.release(), go.wait(20), b"done")[2])
    with ThreadPoolExecutor(4) as pool:
        waiting = [pool.submit(robot.call, "plan", bytes(300_000), 20) for _ in range(3)]
        for _ in waiting:
            assert at_work.acquire(timeout=10)
        with pytest.raises(CallFailedError, match="too many calls to answer"):
            robot.call("plan", bytes(300_000), 5)
        small = pool.submit(robot.call, "plan", bytes(1000), 20)
        assert at_work.acquire(timeout=10)  # there is room for it
        go.set()
        assert [answer.result(10) for answer in (*waiting, small)] == [b"done"] * 4
    assert robot.call("plan", bytes(900_000), 5) == b"done"


def test_names_that_are_no_calls_of_this_end(ends):
    service, robot = ends.pair(topics=TOPICS)
    with pytest.raises(KeyError, match="one of: plan"):
        robot.call("stop", b"", 1)
    with pytest.raises(KeyError, match="one of: plan"):
        service.answer("stop", bytes)


def test_a_late_answer_is_dropped_and_counted(ends, wait_for):
    service, robot = ends.pair(topics=TOPICS)
    go = threading.Event()
    service.answer("plan", lambda request: (go.wait(5), request)[1])
    with pytest.raises(CallTimeoutError, match=r"call 'plan': no answer within 0.05 s"):
        robot.call("plan", b"x", 0.05)
    go.set()
    wait_for(lambda: robot.late_answers == 1)
    assert robot.call("plan", b"y", 5) == b"y"


def test_calls_in_flight_fail_at_once_when_the_peer_is_restarted_or_the_bridge_stops(ends, monkeypatch):
    service, robot = ends.pair(topics=TOPICS)
    asked = threading.Event()
    go = threading.Event()
    service.answer("plan", lambda request: (asked.set(), go.wait(20), request)[2])
    with ThreadPoolExecutor(2) as pool:
        answer = pool.submit(robot.call, "plan", b"x", 30)
        assert asked.wait(5)
        start = time.monotonic()
        send = DatagramSocket.send
        killed = service.address  # as far as anybody hears, without a goodbye
        monkeypatch.setattr(
            DatagramSocket,
            "send",
            lambda own, data, *rest: len(data) if own.address == killed else send(own, data, *rest),
        )
        other = ends.start(Role.SERVICE, topics=TOPICS)
        robot.set_peer(*other.address)
        with pytest.raises(CallFailedError, match="restarted"):
            answer.result(10)
        assert time.monotonic() - start < 5
        other.answer("plan", lambda request: (go.wait(20), request)[1])
        answer = pool.submit(robot.call, "plan", b"x", 30)
        robot.stop()
        with pytest.raises(CallFailedError, match="stopped"):
            answer.result(5)
        go.set()
    with pytest.raises(CallFailedError, match="stopped"):
        robot.call("plan", b"x", 1)
