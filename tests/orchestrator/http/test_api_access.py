"""Every route, for everybody: nobody, a wrong token, the robot itself, another robot, the operator."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import httpx
import pytest

from skytether.api.rest import InstanceCreate, RobotCreate

API = "/api/v1"
WHO = ("nobody", "wrong", "walker", "stranger", "operator")
MANIFEST = {
    "apiVersion": "skytether.io/v1",
    "kind": "Service",
    "metadata": {"name": "new"},
    "spec": {"entrypoint": "x"},
}
ROUTES: list[tuple[str, str, Any, tuple[int, int, int, int, int]]] = [
    # method, path, body, status for each of WHO
    ("GET", "/healthz", None, (200, 200, 200, 200, 200)),
    ("GET", "/readyz", None, (200, 200, 200, 200, 200)),
    ("GET", "/docs", None, (200, 200, 200, 200, 200)),
    ("GET", "/openapi.json", None, (200, 200, 200, 200, 200)),
    ("GET", "/metrics", None, (401, 401, 403, 403, 200)),
    ("GET", f"{API}/prometheus/targets", None, (401, 401, 403, 403, 200)),
    ("GET", f"{API}/catalog", None, (401, 401, 200, 200, 200)),
    ("GET", f"{API}/catalog/toy", None, (401, 401, 200, 403, 200)),
    ("PUT", f"{API}/catalog/new", MANIFEST, (401, 401, 403, 403, 201)),
    ("DELETE", f"{API}/catalog/new", None, (401, 401, 403, 403, 204)),
    ("GET", f"{API}/sites", None, (401, 401, 200, 200, 200)),
    ("POST", f"{API}/sites", {"name": "tmp", "tier": "robot", "runtime": "fake"}, (401, 401, 403, 403, 201)),
    ("GET", f"{API}/sites/lab", None, (401, 401, 200, 200, 200)),
    ("GET", f"{API}/sites/lab/probe", None, (401, 401, 204, 204, 204)),
    ("POST", f"{API}/sites/nowhere/drain", None, (401, 401, 403, 403, 404)),
    ("POST", f"{API}/sites/nowhere/resume", None, (401, 401, 403, 403, 404)),
    ("POST", f"{API}/invitations", {"name": "new"}, (401, 401, 403, 403, 409)),
    ("DELETE", f"{API}/sites/tmp", None, (401, 401, 403, 403, 204)),
    ("GET", f"{API}/groups", None, (401, 401, 403, 403, 200)),
    ("POST", f"{API}/groups", {"name": "bad", "provider": "none", "max": 1}, (401, 401, 403, 403, 422)),
    ("GET", f"{API}/groups/absent", None, (401, 401, 403, 403, 404)),
    ("DELETE", f"{API}/groups/absent", None, (401, 401, 403, 403, 404)),
    ("GET", f"{API}/robots", None, (401, 401, 403, 403, 200)),
    ("POST", f"{API}/robots", {"name": "tmp"}, (401, 401, 403, 403, 201)),
    ("DELETE", f"{API}/robots/tmp", None, (401, 401, 403, 403, 204)),
    ("POST", f"{API}/robots/walker/stop", {"reason": "fire"}, (401, 401, 403, 403, 200)),
    ("POST", f"{API}/robots/stop", {"reason": "fire"}, (401, 401, 403, 403, 200)),
    ("PUT", f"{API}/robots/walker/gate", {"answers": True}, (401, 401, 204, 403, 403)),
    ("PUT", f"{API}/robots/walker/group", {"group": "hall"}, (401, 401, 403, 403, 204)),
    ("GET", f"{API}/robots/walker/stop", None, (401, 401, 200, 403, 200)),
    ("POST", f"{API}/robots/walker/stop/0a/acknowledge", None, (401, 401, 404, 403, 403)),
    ("GET", f"{API}/tokens", None, (401, 401, 403, 403, 200)),
    ("POST", f"{API}/tokens", {"name": "tmp", "scopes": ["read"]}, (401, 401, 403, 403, 201)),
    ("POST", f"{API}/tokens/none/rotate", {}, (401, 401, 403, 403, 404)),
    ("DELETE", f"{API}/tokens/none", None, (401, 401, 403, 403, 204)),
    ("GET", f"{API}/instances", None, (401, 401, 200, 200, 200)),
    ("POST", f"{API}/instances", {"robot": "walker", "service": "toy"}, (401, 401, 201, 403, 201)),
    ("GET", f"{API}/instances/ID", None, (401, 401, 200, 404, 200)),
    ("PATCH", f"{API}/instances/ID", {"cpu": 0}, (401, 401, 403, 403, 422)),
    ("POST", f"{API}/instances/ID/renew", {}, (401, 401, 200, 404, 200)),
    ("POST", f"{API}/instances/ID/share", {}, (401, 401, 409, 404, 403)),
    ("POST", f"{API}/instances/ID/session", {"claim": "c" * 16}, (401, 401, 200, 404, 200)),
    ("POST", f"{API}/instances/ID/migrate", {"site": "lab"}, (401, 401, 409, 404, 409)),
    ("GET", f"{API}/instances/ID/logs", None, (401, 401, 200, 404, 200)),
    ("GET", f"{API}/instances/ENDED/events", None, (401, 401, 200, 404, 200)),
    ("DELETE", f"{API}/instances/ENDED", None, (401, 401, 204, 404, 204)),
]


@dataclass
class People:
    served: Any
    headers: dict[str, dict[str, str]]
    running: str
    ended: str
    http: httpx.Client


@pytest.fixture(scope="module")
def people(shared: Any) -> Iterator[People]:
    shared.site("lab")
    operator = shared.operator
    tokens = {
        "wrong": "sky-" + "0" * 64,
        "walker": operator.create_robot(RobotCreate(name="walker")).token,
        "stranger": operator.create_robot(RobotCreate(name="stranger", services=("other",))).token,
        "operator": shared.token,
    }
    headers: dict[str, dict[str, str]] = {who: {"Authorization": f"Bearer {t}"} for who, t in tokens.items()}
    request = InstanceCreate(robot="walker", service="toy", lease_s=1000)
    running, ended = operator.create_instance(request), operator.create_instance(request)
    operator.wait_running(running.id)
    operator.delete_instance(ended.id)
    assert list(operator.watch(ended.id, timeout=5))[-1].state.final
    with httpx.Client(trust_env=False, verify=False) as http:
        yield People(shared, {"nobody": {}, **headers}, running.id, ended.id, http)


@pytest.mark.parametrize("who", WHO)
@pytest.mark.parametrize(("method", "path", "body", "statuses"), ROUTES, ids=[f"{m} {p}" for m, p, *_ in ROUTES])
def test_who_may_what(people: People, who: str, method: str, path: str, body: Any, statuses: tuple[int, ...]) -> None:
    url = people.served.url + path.replace("ID", people.running).replace("ENDED", people.ended)
    if method == "DELETE" and path == f"{API}/sites/tmp":  # another process may have made the one before
        tmp = {"name": "tmp", "tier": "robot", "runtime": "fake"}
        people.http.post(f"{people.served.url}{API}/sites", json=tmp, headers=people.headers["operator"])
    answer = people.http.request(method, url, json=body, headers=people.headers[who])
    assert answer.status_code == statuses[WHO.index(who)], answer.text
    if answer.is_error:
        problem = answer.json()
        assert answer.headers["content-type"] == "application/problem+json"
        assert problem["status"] == answer.status_code
        assert problem["detail"]
        assert (answer.headers.get("www-authenticate") == "Bearer") is (answer.status_code == 401)


def test_every_route_is_in_the_list(people: People) -> None:
    described = {
        (method.upper(), path)
        for path, methods in people.http.get(people.served.url + "/openapi.json").json()["paths"].items()
        for method in methods
    }
    parameters = {
        "lab": "{site}",
        "nowhere": "{site}",
        "absent": "{group}",
        "tmp": "{}",
        "toy": "{service}",
        "new": "{service}",
        "ID": "{instance}",
    }
    parameters |= {"none": "{token}", "walker": "{robot}", "0a": "{order}"}
    parameters["ENDED"] = "{instance}"
    listed = set()
    for method, path, *_ in ROUTES:
        parts = [parameters.get(part, part) for part in path.split("/")]
        kind = "{site}" if "sites" in parts else "{robot}"
        listed.add((method, "/".join(kind if part == "{}" else part for part in parts)))
    assert described <= listed


def test_a_robot_sees_its_own_instances_its_own_services_and_no_options(people: People) -> None:
    def get(who: str, path: str) -> Any:
        return people.http.get(people.served.url + API + path, headers=people.headers[who]).json()

    assert {i["robot"] for i in get("walker", "/instances")} == {"walker"}
    assert get("stranger", "/instances") == []
    assert all(i["session"] is None for i in get("operator", "/instances"))
    assert get("stranger", "/catalog") == []
    assert "toy" in [m["metadata"]["name"] for m in get("walker", "/catalog")]


def test_a_robot_may_ask_only_for_itself_and_what_it_is_allowed(people: People) -> None:
    def ask(who: str, robot: str, service: str) -> str:
        body = {"robot": robot, "service": service}
        url = people.served.url + API + "/instances"
        answer = people.http.post(url, json=body, headers=people.headers[who])
        assert answer.status_code == 403
        return str(answer.json()["detail"])

    assert ask("walker", "stranger", "toy") == "robot 'walker' may ask for itself only, not for 'stranger'"
    assert ask("stranger", "stranger", "toy") == "robot 'stranger' may not ask for 'toy'; it may ask for: other"


@pytest.mark.parametrize("header", ["Basic abc", "Bearer", "sky-123", "Bearer ünïcode"])
def test_odd_authorization_headers_are_nobody(people: People, header: str) -> None:
    headers = {"Authorization": header.encode()}
    answer = people.http.get(people.served.url + API + "/sites", headers=headers)  # type: ignore[arg-type]
    assert answer.status_code == 401
    assert "token" in answer.json()["detail"]


def test_a_token_that_was_revoked_a_moment_ago_renews_nothing(shared: Any, people: People) -> None:
    """Its body may be read still, as of somebody who was known; what it says is not done."""
    token = shared.operator.create_robot(RobotCreate(name="leaver")).token
    path, headers = f"{people.served.url}{API}/instances/{people.running}/renew", {"Authorization": f"Bearer {token}"}
    assert people.http.post(path, json={}, headers=headers).status_code == 404  # another's: who asks is known
    shared.operator.delete_robot("leaver")
    answers = [people.http.post(path, json={}, headers=headers) for _ in range(2)]
    assert [answer.status_code for answer in answers] == [401, 401]
