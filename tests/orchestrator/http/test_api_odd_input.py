"""What could be stored but never given back is refused at the door, and nothing of it is left."""

from __future__ import annotations

import socket
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest
from pydantic import ValidationError

from skytether.api.client import ApiError
from skytether.api.rest import (
    MOST_COUNTED,
    MOST_TOPICS,
    GateReport,
    Measurement,
    Renew,
    Report,
    RobotCreate,
    Share,
    TopicReport,
)
from skytether.orchestrator.config.settings import ServerLimits

ASK = '{"robot": "walker", "service": "toy", "params": {"mass": %s}}'


@pytest.fixture
def http(shared: Any) -> Any:
    headers = {"Authorization": f"Bearer {shared.token}", "Content-Type": "application/json"}
    with httpx.Client(base_url=f"{shared.url}/api/v1", headers=headers) as client:
        yield client


@pytest.mark.parametrize(
    ("value", "sentence"),
    [
        ("NaN", "params.mass: must be a finite number, not nan"),
        ("1e999", "params.mass: must be a finite number, not inf"),
        ("1" * 400, "params.mass: must be a whole number of at most 64 bits"),
        (r'"\u0000"', "params.mass: holds a NUL character: leave it out"),
        (r'"\ud800"', "params.mass: holds half a character (a lone surrogate): leave it out"),
        ("[" * 300 + "]" * 300, "params.mass.0: is nested more than 64 levels deep"),
        ('1, "mass": 2', "the key 'mass' comes twice: leave one of them out"),
        (f'["{"x" * 20_000}", NaN]', "params.mass.1: must be a finite number, not nan"),
    ],
)
def test_a_body_that_could_not_be_given_back(http: httpx.Client, value: str, sentence: str) -> None:
    answer = http.post("/instances", content=ASK % value)
    assert (answer.status_code, answer.json()["detail"]) == (422, sentence)
    listed = http.get("/instances")
    assert (listed.status_code, listed.json()) == (200, [])


def test_a_delay_that_nothing_can_be_reckoned_with() -> None:
    for key in ("rtt_ms", "jitter_ms"):
        with pytest.raises(ValidationError, match="less than or equal to 3600000"):
            Measurement.model_validate({key: 1e308})


@pytest.mark.parametrize("path", ["/instances/%00", "/catalog/%00", "/sites/%00"])
def test_a_name_that_no_database_knows(http: httpx.Client, path: str) -> None:
    for method in ("GET", "DELETE"):
        answer = http.request(method, path)
        assert (answer.status_code, answer.json()["title"]) == (404, "Not found")


ASTRAY = ("../robots/walker", "", ".", "..", "toy#x", "toy?x=1", "a/b", "a\nb", "a b", "%2e%2e", "x" * 65, "ä", "/")


def test_a_name_that_is_a_path_leads_nowhere_else(served: Any) -> None:
    """`instance delete ../robots/walker` once deleted a robot, with its token."""
    served.site("lab")
    operator = served.operator
    operator.create_robot(RobotCreate(name="walker"))
    before = (operator.robots(), operator.services(), operator.tokens(), [site.name for site in operator.sites()])
    for name in ASTRAY:
        for ask in (
            operator.get_instance,
            operator.delete_instance,
            operator.renew_instance,
            operator.migrate_instance,
            operator.logs,
            lambda name: list(operator.follow_logs(name)),
            lambda name: list(operator.watch(name)),
            lambda name: operator.claim_session(name, "c" * 16),
            operator.get_service,
            operator.delete_service,
            lambda name: operator.put_service(name, {}),
            lambda name: operator.apply_service(name, {}),
            operator.get_site,
            operator.delete_site,
            operator.probe,
            operator.delete_robot,
            lambda name: operator.stop_robot(name, "why"),
            operator.stop_order,
            lambda name: operator.acknowledge_stop(name, "order"),
            lambda name: operator.acknowledge_stop("walker", name),
            lambda name: operator.report_gate(name, GateReport()),
            lambda name: operator.set_group(name, "hall"),
            lambda name: operator.share(name, Share()),
            operator.rotate_token,
            operator.delete_token,
        ):
            with pytest.raises(ApiError, match="is not a valid name") as caught:
                ask(name)
            assert caught.value.problem.status == 404
    assert (operator.robots(), operator.services(), operator.tokens(), [s.name for s in operator.sites()]) == before


@pytest.mark.parametrize(
    "path",
    [
        "/instances/../robots/walker",
        "/instances/%2e%2e/robots/walker",
        "/instances/..%2frobots%2fwalker",
        "/instances/",
        "/instances//renew",
        "//robots/walker",
        "/robots/walker/",
        "/robots/wal%0aker",
        "/robots/walker%20",
        "/robots/%2e",
        "/robots/toy%23x",
    ],
)
def test_so_it_is_whoever_asks(served: Any, path: str) -> None:
    served.operator.create_robot(RobotCreate(name="walker"))
    where = urlsplit(served.url)
    for method in ("GET", "DELETE", "POST"):
        head = f"{method} /api/v1{path} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {served.token}\r\n"
        with socket.create_connection((where.hostname or "", where.port or 0)) as raw:  # no client tidies the path
            raw.sendall(f"{head}Content-Length: 0\r\nConnection: close\r\n\r\n".encode())
            raw.settimeout(30)
            answer = b"".join(iter(lambda: raw.recv(65_536), b""))
        assert answer.split()[1] in (b"404", b"405"), answer
    assert [robot.name for robot in served.operator.robots()] == ["walker"]


@pytest.mark.parametrize(
    ("report", "sentence"),
    [
        ({"topics": [{}] * 60_000}, "report.topics.0.topic: is missing; "),
        ({f"k{n}": 1 for n in range(15_000)}, "has more than 4096 keys"),
        ({f"k{n}": 1 for n in range(4_000)}, "report.k0: unknown key; "),
        ({"topics": [{f"k{n}": 1 for n in range(20)}] * 1000}, "report.topics.0.topic: is missing; "),
    ],
)
def test_what_has_thousands_of_faults_costs_no_more_than_what_has_ten(
    http: httpx.Client, report: Any, sentence: str
) -> None:
    """To find and tell them all took a second, in which nobody was answered."""
    answer = http.post("/instances/i1/renew", json={"report": report})
    told = answer.json()
    assert answer.status_code == 422
    assert told["detail"].startswith(sentence.removesuffix("; ")), told["detail"][:200]
    assert len(told["errors"]) <= 10
    assert len(answer.content) < 10_000


def test_a_robot_of_a_thousand_topics_renews(http: httpx.Client) -> None:
    delays = dict.fromkeys(("delay_p50_s", "delay_p99_s", "jitter_s"), 1 / 7_000)
    counters = dict.fromkeys(("sent", "delivered", "lost", "expired"), MOST_COUNTED >> 20)
    row = TopicReport(topic="x" * 32, direction="out", priority=100, bytes_sent=MOST_COUNTED, **delays, **counters)
    body = Renew(report=Report(topics=(row,) * MOST_TOPICS)).model_dump(mode="json")
    answer = http.post("/instances/i1/renew", json=body)
    assert (answer.status_code, answer.json()["title"]) == (404, "Not found")  # of the instance
    assert len(answer.request.content) < ServerLimits().robot_body_bytes


def test_a_report_is_read_up_to_its_first_fault() -> None:
    with pytest.raises(ValidationError) as caught:
        Report.model_validate({"topics": [{}] * 1000})
    assert caught.value.error_count() == 3  # keys that the first topic lacks
