"""The HTTP interface over a real server on loopback."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any

import httpx
import pytest

from skytether.api.client import ApiError, NotRunning
from skytether.api.rest import (
    InstanceCreate,
    Measurement,
    Renew,
    Report,
    RobotCreate,
    SessionKey,
    SiteCreate,
    State,
    TopicReport,
)
from skytether.orchestrator.config.settings import Timing
from skytether.orchestrator.scheduling.runtime_entry_points import RUNTIMES

ASK = InstanceCreate(robot="walker", service="toy", lease_s=1000)


def refused(call: Any, *arguments: Any, **named: Any) -> tuple[int, str]:
    with pytest.raises(ApiError) as caught:
        call(*arguments, **named)
    return caught.value.problem.status, str(caught.value)


def test_the_whole_life_of_an_instance(served: Any) -> None:
    fake = served.site()
    robot = served.robot()
    made = robot.create_instance(ASK)
    assert made.state in (State.PENDING, State.PLACING, State.STARTING)
    running = robot.wait_running(made.id, timeout=5)
    assert running.id == made.id
    assert running.placement.site == "lab"
    session = running.session
    assert len(session.id) == 16
    assert (session.host, session.port) == ("127.0.0.1", 40_000)
    grant = fake.world[made.id].launch.grant
    assert session.key is None
    key = robot.claim_session(made.id, "c" * 16)
    assert (grant.session_id, grant.session_key) == (session.id, key)
    assert key not in repr(SessionKey(key=key))
    assert "run 1 of toy" in robot.logs(made.id)
    assert "run 1 of toy" in "".join(robot.follow_logs(made.id))  # fakes cannot be followed: what there is
    robot.delete_instance(made.id)
    robot.delete_instance(made.id)
    assert [e.state for e in robot.watch(made.id, timeout=5)] == [
        "pending",
        "placing",
        "starting",
        "running",
        "stopping",
        "stopped",
    ]
    ended = robot.get_instance(made.id)
    assert (ended.state, ended.reason) == (State.STOPPED, "")
    robot.delete_instance(made.id)


def test_the_same_key_gives_the_same_instance(served: Any) -> None:
    served.site()
    robot = served.robot()
    first = robot.create_instance(ASK, idempotency_key="k1")
    again = robot.create_instance(ASK, idempotency_key="k1")
    assert (again.id, again.session.id) == (first.id, first.session.id)
    assert robot.create_instance(ASK, idempotency_key="k2").id != first.id
    other = ASK.model_copy(update={"lease_s": 999.0})
    status, text = refused(robot.create_instance, other, idempotency_key="k1")
    assert (status, text) == (422, "Idempotency-Key: came before with another body: use a new key for a new request")
    assert served.operator.create_instance(ASK, idempotency_key="k1").id != first.id


def test_a_key_is_honoured_when_the_service_is_gone_meanwhile(served: Any) -> None:
    served.site()
    operator = served.operator
    first = operator.create_instance(ASK, idempotency_key="k")
    operator.delete_service("toy")
    assert operator.create_instance(ASK, idempotency_key="k").id == first.id


def test_an_unknown_service_names_the_known_ones(served: Any) -> None:
    served.site()
    ask = ASK.model_copy(update={"service": "tyo"})
    status, text = refused(served.operator.create_instance, ask)
    assert status == 404
    assert text.startswith("there is no service 'tyo'; known are: ")
    assert "toy" in text


@pytest.mark.parametrize(
    ("params", "text"),
    [
        ({"mass": -1}, "service 'toy': params.mass: -1 is less than the minimum of 0"),
        ({"mas": 1}, "service 'toy': params.mas: unknown key, did you mean 'mass'?"),
    ],
)
def test_wrong_parameters_name_the_key(shared: Any, params: dict[str, Any], text: str) -> None:
    ask = ASK.model_copy(update={"params": params})
    assert refused(shared.operator.create_instance, ask) == (422, text)


def test_a_missing_parameter_names_the_key(shared: Any, manifest: Any) -> None:
    operator = shared.operator
    operator.put_service("strict", manifest("strict", params={"required": ["mass"], "properties": {"mass": {}}}))
    ask = ASK.model_copy(update={"service": "strict"})
    assert refused(operator.create_instance, ask) == (422, "service 'strict': params.mass: is missing")
    operator.delete_service("strict")


def test_no_site_at_all(served: Any) -> None:
    status, text = refused(served.operator.create_instance, ASK)
    assert (status, text) == (409, "no site can run 'toy': there is none: add one with `skytether site add`")


def test_a_site_that_was_added_at_another_orchestrator_a_moment_ago_counts(served_with: Callable[..., Any]) -> None:
    served = served_with(timing=Timing(place=1000))
    served.core.store.add_site(SiteCreate(name="lab", tier="edge", runtime="fake"))
    assert served.operator.create_instance(ASK).state is State.PENDING


def test_no_site_that_ever_could_says_each_ones_number(served: Any, manifest: Any) -> None:
    served.site("small", cpu=1)
    served.site("far")
    operator = served.operator
    operator.put_service("toy", manifest(needs={"cpu": 4, "max_rtt_ms": 50}))
    ask = ASK.model_copy(update={"measurements": {"far": Measurement(rtt_ms=80)}})
    with pytest.raises(ApiError) as caught:
        operator.create_instance(ask)
    assert caught.value.problem.status == 409
    assert {(e["site"], e["reason"]) for e in caught.value.problem.errors} == {("small", "cpu"), ("far", "rtt")}
    assert "needs 4 cores, the site has 1" in str(caught.value)
    assert "round trip measured 80 ms, at most 50 ms allowed" in str(caught.value)
    assert operator.instances() == []
    assert 'skytether_placement_refusals_total{reason="rtt",service="toy",site="far"} 1.0' in operator.metrics()


def test_a_full_site_makes_it_wait(served: Any, manifest: Any) -> None:
    served.site(cpu=1)
    operator = served.operator
    operator.put_service("toy", manifest(needs={"cpu": 1}))
    first, second = operator.create_instance(ASK), operator.create_instance(ASK)
    operator.wait_running(first.id, timeout=5)
    with pytest.raises(NotRunning, match=r"is pending after 0.2 s: waiting for a site: lab: needs 1 cores, 0 of 1"):
        operator.wait_running(second.id, timeout=0.2)
    operator.delete_instance(first.id)
    assert operator.wait_running(second.id, timeout=5).state is State.RUNNING


def test_a_service_that_ends_at_once_is_failed_with_its_last_line(served: Any) -> None:
    served.site(runtime="crashing")
    robot = served.robot()
    made = robot.create_instance(ASK)
    with pytest.raises(NotRunning, match=r'is failed: given up after 5 failures in a row: .* its last line: "boom"'):
        robot.wait_running(made.id, timeout=10)
    assert robot.get_instance(made.id).restarts == 4


def test_renewing_keeps_the_lease_and_does_not_revive(served: Any) -> None:
    served.site()
    robot = served.robot()
    made = robot.wait_running(robot.create_instance(ASK).id, timeout=5)
    renewed = robot.renew_instance(made.id, Renew(lease_s=2000))
    assert (renewed.lease_expires_at - made.lease_expires_at).total_seconds() > 900
    assert renewed.updated_at == made.updated_at
    robot.delete_instance(made.id)
    assert list(robot.watch(made.id, timeout=5))[-1].state is State.STOPPED
    assert robot.renew_instance(made.id).state is State.STOPPED


@pytest.mark.slow
def test_of_sites_that_are_not_there_nothing_is_kept(served: Any) -> None:
    served.site("lab")
    robot = served.robot()
    names = {f"s{n}": Measurement(rtt_ms=n) for n in range(200)}
    asked = ASK.model_copy(update={"measurements": {**names, "lab": Measurement(rtt_ms=7)}})
    made = robot.create_instance(asked)
    record = served.core.store.get(made.id)
    assert record.measurements == {"lab": {"rtt_ms": 7, "preferred": False}}
    robot.renew_instance(made.id, Renew(measurements={**names, "lab": Measurement(rtt_ms=8)}))
    assert served.core.store.get(made.id).measurements == {"lab": {"rtt_ms": 8, "preferred": False}}
    many = {f"s{n}": {"rtt_ms": 1} for n in range(257)}
    renewal = f"{served.url}/api/v1/instances/{made.id}/renew"
    asked_for = {"Authorization": f"Bearer {served.token}"}
    assert httpx.post(renewal, json={"measurements": many}, headers=asked_for).status_code == 422


def test_an_instance_that_is_not_renewed_ends(served: Any) -> None:
    served.site()
    robot = served.robot()
    made = robot.create_instance(ASK.model_copy(update={"lease_s": 1.0}))
    last = list(robot.watch(made.id, timeout=5))[-1]
    assert (last.state, last.reason) == (State.STOPPED, "the robot did not renew its lease of 1 s")


def test_reports_reach_the_metrics_and_go_with_the_instance(served: Any, manifest: Any) -> None:
    served.site()
    operator, robot = served.operator, served.robot()
    operator.put_service("toy", manifest(topics=[{"name": "scan", "type": "a/msg/B", "direction": "in"}]))
    made = robot.wait_running(robot.create_instance(ASK).id, timeout=5)
    topics = (TopicReport(topic="scan", direction="in", priority=64, sent=10, delivered=9, lost=1, delay_p50_s=0.05),)
    robot.renew_instance(made.id, Renew(report=Report(rtt_s=0.1, topics=topics, control_source="cloud")))
    text = operator.metrics()
    assert 'skytether_path_rtt_seconds{robot="walker",service="toy",site="lab"} 0.1' in text
    assert 'outcome="lost"' in text
    assert made.id not in text
    assert made.session.id not in text
    robot.delete_instance(made.id)
    assert list(robot.watch(made.id, timeout=5))[-1].state.final
    end = time.monotonic() + 10
    while 'robot="walker"' in operator.metrics():  # its stream's end is counted after the robot saw it
        assert time.monotonic() < end


def test_revoking_a_robot_ends_what_it_holds(served: Any) -> None:
    served.site()
    operator, robot = served.operator, served.robot()
    made = robot.wait_running(robot.create_instance(ASK).id, timeout=5)
    operator.delete_robot("walker")
    last = list(operator.watch(made.id, timeout=5))[-1]
    assert (last.state, last.reason) == (State.STOPPED, "the robot's token was revoked")
    assert refused(robot.instances)[0] == 401
    operator.delete_robot("walker")


def test_robots(served: Any) -> None:
    operator = served.operator
    made = operator.create_robot(RobotCreate(name="walker", services=("toy",)))
    assert made.token.startswith("sky-")
    assert made.token not in repr(made)
    assert refused(operator.create_robot, RobotCreate(name="walker"))[0] == 409
    assert operator.robots()[0].last_seen_at is None
    served.client(made.token).instances()
    listed = operator.robots()[0]
    assert (listed.name, listed.services) == ("walker", ("toy",))
    assert listed.last_seen_at is not None


def test_sites(served: Any) -> None:
    operator = served.operator
    site = operator.create_site(SiteCreate(name="lab", tier="edge", runtime="fake", options={"cpu": 4}))
    assert (site.state, site.cpu, site.instances, site.options) == ("ready", 4, 0, {"cpu": 4})
    robot = served.robot()
    assert robot.get_site("lab").options == {}
    assert robot.probe("lab") < 1
    assert refused(robot.probe, "bal") == (404, "there is no site 'bal'; known are: lab")
    assert refused(operator.create_site, SiteCreate(name="lab", tier="edge", runtime="fake"))[0] == 409
    made = robot.wait_running(robot.create_instance(ASK).id, timeout=5)
    status, text = refused(operator.delete_site, "lab")
    drain = "or drain it: it takes no more, and is deleted with its last one"
    assert (status, text) == (409, f"site 'lab' has 1 instances: delete them first ({made.id}), {drain}")
    served.fleet.made["lab"].silent = True
    while operator.get_site("lab").state == "ready":
        pass
    assert operator.get_site("lab").reason == "site lab does not answer"
    served.fleet.made["lab"].silent = False
    robot.delete_instance(made.id)
    assert list(robot.watch(made.id, timeout=5))[-1].state.final
    operator.delete_site("lab")
    assert operator.sites() == []
    assert refused(operator.delete_site, "lab")[0] == 404


INSTALLED = ", ".join(sorted(point.name for point in entry_points(group=RUNTIMES)))


@pytest.mark.parametrize(
    ("runtime", "options", "text"),
    [
        ("dokcer", {}, f"runtime: there is no runtime 'dokcer'; installed are: {INSTALLED}"),
        ("process", {"advertise": "x"}, "options.advertise: unknown key, did you mean 'advertise_host'?"),
    ],
)
def test_a_wrong_site_is_refused(shared: Any, runtime: str, options: dict[str, Any], text: str) -> None:
    site = SiteCreate(name="wrong", tier="edge", runtime=runtime, options=options)
    assert refused(shared.operator.create_site, site) == (422, text)
    assert "wrong" not in [s.name for s in shared.operator.sites()]


def test_a_site_that_can_start_nothing_says_why(served: Any) -> None:
    runtime = served.site(runtime="blocked")
    operator = served.operator
    assert [(s.state, s.reason, s.cpu) for s in operator.sites()] == [("blocked", "the network is missing", 64)]
    waiting = operator.create_instance(ASK)
    end = time.monotonic() + 10
    while not operator.get_instance(waiting.id).reason and time.monotonic() < end:  # until the placer has looked
        time.sleep(0.02)
    with pytest.raises(NotRunning, match=r"is pending after 0.2 s: waiting for a site: lab: the network is missing"):
        operator.wait_running(waiting.id, timeout=0.2)
    runtime.obstacle = ""
    assert operator.wait_running(waiting.id, timeout=5).state is State.RUNNING
    assert (operator.get_site("lab").state, operator.get_site("lab").reason) == ("ready", "")


def test_services(served: Any, manifest: Any) -> None:
    operator = served.operator
    assert operator.get_service("toy").spec.entrypoint == "skytether.testing.toy_service"
    changed = operator.put_service("toy", manifest(entrypoint="another"))
    assert operator.get_service("toy") == changed
    operator.delete_service("toy")
    operator.delete_service("toy")
    assert refused(operator.get_service, "toy")[0] == 404
    typo = manifest(topics=[{"name": "a", "type": "b", "direction": "in", "prority": 3}])
    assert refused(operator.put_service, "toy", typo) == (
        422,
        "spec.topics.0.prority: unknown key, did you mean 'priority'?",
    )
    assert refused(operator.put_service, "yot", manifest("toy"))[0] == 422


@pytest.mark.parametrize(
    ("method", "path", "content", "status", "text"),
    [
        ("GET", "/nowhere", b"", 404, "there is nothing at /nowhere: see /docs for what there is"),
        ("PATCH", "/api/v1/sites", b"", 405, "PATCH is not possible on /api/v1/sites: see /docs for what is"),
        ("POST", "/api/v1/instances", b"{", 422, "the body is no JSON: expecting property name"),
        ("POST", "/api/v1/instances", b"", 422, "body: "),
        ("POST", "/api/v1/instances", b"[]", 422, "body: "),
        (
            "POST",
            "/api/v1/instances",
            b'{"robot":"r","servise":"toy"}',
            422,
            "servise: unknown key, did you mean 'service'",
        ),
        ("POST", "/api/v1/instances", b'{"robot":"R!","service":"toy"}', 422, "robot: string should match pattern"),
        ("POST", "/api/v1/instances", b" " * (2 << 20), 413, "the request is larger than 1048576 bytes"),
        ("GET", "/api/v1/instances/x/logs?tail=0", b"", 422, "tail: input should be greater than or equal to 1"),
        ("GET", "/api/v1/instances/x", b"", 404, "there is no instance 'x'"),
    ],
)
def test_every_error_is_a_problem_document(
    shared: Any, method: str, path: str, content: bytes, status: int, text: str
) -> None:
    headers = {"Authorization": f"Bearer {shared.token}", "Content-Type": "application/json"}
    answer = httpx.request(method, shared.url + path, content=content, headers=headers, trust_env=False, verify=False)
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"
    problem = answer.json()
    assert text in problem["detail"]
    assert problem["instance"] == path.split("?")[0]
    assert "Traceback" not in answer.text


def test_a_mistake_of_ours_is_told_without_a_traceback(
    served: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def break_down() -> None:
        raise ZeroDivisionError("secret detail")

    monkeypatch.setattr(served.core.store, "robots", break_down)
    headers = {"Authorization": f"Bearer {served.token}"}
    answer = httpx.get(served.url + "/api/v1/robots", headers=headers, trust_env=False, verify=False)
    assert answer.status_code == 500
    assert answer.json()["detail"] == "a mistake in the orchestrator: its log has the details"
    assert "secret detail" not in answer.text
    assert "ZeroDivisionError" in caplog.text
    assert served.token not in caplog.text


def test_not_ready_when_the_database_is_gone(
    served: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def no_answer() -> None:
        raise OSError("disk on fire")

    monkeypatch.setattr(served.core.store, "ping", no_answer)
    answer = httpx.get(served.url + "/readyz", trust_env=False, verify=False)
    assert (answer.status_code, answer.json()["detail"]) == (503, "the database does not answer")
    assert "disk on fire" in caplog.text
    assert httpx.get(served.url + "/healthz", trust_env=False, verify=False).status_code == 200


def test_many_requests_at_once(served: Any) -> None:
    served.site()
    robot = served.robot()
    made: list[Any] = []

    def ask() -> None:
        made.append(robot.wait_running(robot.create_instance(ASK).id, timeout=10))

    threads = [threading.Thread(target=ask) for _ in range(12)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({i.id for i in made}) == len({i.session.id for i in made}) == 12
    assert len({i.session.port for i in made}) == 12


def test_a_body_of_unknown_length_is_bounded_too(shared: Any) -> None:
    headers = {"Authorization": f"Bearer {shared.token}", "Content-Type": "application/json"}
    chunks = (b" " * 65_536 for _ in range(32))
    url = shared.url + "/api/v1/instances"
    answer = httpx.post(url, content=chunks, headers=headers, trust_env=False, verify=False)
    assert answer.status_code == 413
    assert answer.json()["status"] == 413


def test_what_a_site_failed_to_start_is_told_operators(served_with: Callable[..., Any]) -> None:
    served = served_with(timing=Timing())
    served.site()
    robot, fitness = served.robot(), served.core.sites.get("lab").fitness
    made = robot.wait_running(robot.create_instance(ASK).id, timeout=5)
    record = served.core.store.get(made.id)
    fitness.failed(record, "ended with exit status 1", time.monotonic(), 1_784_894_400.0)
    (unfit,) = served.operator.get_site("lab").unfit
    assert (unfit.service, unfit.reason, unfit.failures, unfit.robots) == (
        "toy",
        "ended with exit status 1",
        1,
        ("walker",),
    )
    assert unfit.until.isoformat() == "2026-07-24T12:00:30+00:00"
    assert served.operator.get_site("lab").state == "ready", "it can start everything else"
    assert robot.get_site("lab").unfit == ()
    waiting = robot.create_instance(ASK)
    while not (reason := robot.get_instance(waiting.id).reason):
        pass
    again = "tried again at 12:00:30 UTC"
    assert reason == f"waiting for a site: lab: cannot start it: the service ended with exit status 1; {again}"


def test_a_site_that_is_drained_takes_no_more_and_goes_with_its_last_instance(served: Any) -> None:
    served.site("lab")
    operator, robot = served.operator, served.robot()
    runs = robot.wait_running(robot.create_instance(ASK).id, timeout=5)
    assert operator.delete_site("lab", drain=True) is False
    assert operator.get_site("lab").draining
    status, text = refused(robot.create_instance, ASK)
    assert (status, text) == (409, "no site can run 'toy': lab: is being deleted, and takes no more instances")
    served.site("other")
    placement = robot.wait_running(robot.create_instance(ASK).id, timeout=5).placement
    assert placement is not None
    assert (placement.site, placement.refused[0].reason) == ("other", "draining")
    assert refused(operator.migrate_instance, robot.instances()[0].id, "lab")[0] == 409
    assert robot.get_instance(runs.id).state is State.RUNNING
    robot.delete_instance(runs.id)
    until_gone(operator, "lab")
    assert operator.delete_site("other", drain=True) is False


def test_what_holds_nothing_is_gone_at_once_and_a_standby_keeps_no_site(served: Any, manifest: Any) -> None:
    served.site("lab")
    operator = served.operator
    assert operator.delete_site("lab", drain=True) is True
    assert refused(operator.delete_site, "lab")[0] == 404
    served.site("warm")
    operator.put_service("toy", manifest(needs={"standby": 1}))
    while not any(instance.placement for instance in operator.instances()):
        time.sleep(0.02)
    assert operator.delete_site("warm", drain=True) is False
    until_gone(operator, "warm")


def until_gone(operator: Any, site: str) -> None:
    end = time.monotonic() + 10
    while site in [one.name for one in operator.sites()]:
        assert time.monotonic() < end
        time.sleep(0.05)
