from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

from skytether.api.client import ApiError, Client, NotRunning, Unreachable
from skytether.api.rest import InstanceCreate, Renew, RobotCreate, State

Answer = tuple[int, str, bytes]
"""Status, content type, body."""
NOW = "2026-01-01T00:00:00Z"
INSTANCE = {
    "id": "i1",
    "robot": "walker",
    "service": "toy",
    "state": "running",
    "created_at": NOW,
    "updated_at": NOW,
    "lease_expires_at": NOW,
}


class Script:
    """A server that answers what the test says, and remembers what it was asked."""

    def __init__(self) -> None:
        self.answers: dict[tuple[str, str], Answer] = {}
        self.asked: list[tuple[str, str, dict[str, str], Any]] = []
        self.late: dict[tuple[str, str], float] = {}
        """How long some answers take [s]."""
        self.url = ""

    def says(self, method: str, path: str, document: Any, status: int = 200) -> None:
        self.answers[method, path] = (status, "application/json", json.dumps(document).encode())


@pytest.fixture
def script() -> Iterator[Script]:
    script = Script()

    class Handler(BaseHTTPRequestHandler):
        def handle_any(self) -> None:
            body = self.rfile.read(int(self.headers.get("content-length", 0)))
            headers = {k.lower(): v for k, v in self.headers.items()}
            script.asked.append((self.command, self.path, headers, json.loads(body) if body else None))
            time.sleep(script.late.get((self.command, self.path), 0))
            status, kind, content = script.answers[self.command, self.path]
            self.send_response(status)
            self.send_header("Content-Type", kind)
            if status != 204:
                self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        do_GET = do_POST = do_PUT = do_DELETE = handle_any  # noqa: N815

        def log_message(self, *_: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    script.url = f"http://127.0.0.1:{server.server_address[1]}"
    yield script
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def client(script: Script) -> Iterator[Client]:
    with Client(script.url + "/", "sky-token") as client:
        yield client


def test_requests_carry_token_body_and_idempotency_key(script: Script, client: Client) -> None:
    script.says("POST", "/api/v1/instances", INSTANCE, 201)
    made = client.create_instance(InstanceCreate(robot="walker", service="toy", params={"a": 1}), idempotency_key="k")
    assert made.state is State.RUNNING
    _, _, headers, body = script.asked[0]
    assert headers["authorization"] == "Bearer sky-token"
    assert headers["idempotency-key"] == "k"
    assert body["params"] == {"a": 1}
    client.create_instance(InstanceCreate(robot="walker", service="toy"))
    client.create_instance(InstanceCreate(robot="walker", service="toy"))
    keys = [headers["idempotency-key"] for _, _, headers, _ in script.asked]
    assert len(set(keys)) == 3, "a key of its own for each request that brings none"


def test_small_verbs(script: Script, client: Client) -> None:
    script.says("GET", "/api/v1/instances", [INSTANCE])
    script.says("GET", "/api/v1/instances/i1", INSTANCE)
    script.says("POST", "/api/v1/instances/i1/renew", INSTANCE)
    script.answers["DELETE", "/api/v1/instances/i1"] = (204, "text/plain", b"")
    script.answers["GET", "/api/v1/sites/lab/probe"] = (204, "text/plain", b"")
    script.answers["GET", "/api/v1/instances/i1/logs?tail=7"] = (200, "text/plain", "grün\n".encode())
    assert [i.id for i in client.instances()] == ["i1"]
    assert client.get_instance("i1").robot == "walker"
    client.renew_instance("i1", Renew(lease_s=3))
    assert script.asked[-1][3]["lease_s"] == 3
    client.renew_instance("i1")
    client.delete_instance("i1")
    assert 0 < client.probe("lab") < 5
    assert client.logs("i1", tail=7) == "grün\n"
    script.answers["GET", "/api/v1/instances/i1/logs?tail=7&follow=true"] = (200, "text/plain", b"as it comes\n")
    script.says("GET", "/api/v1/instances/i1", INSTANCE)
    assert "".join(client.follow_logs("i1", tail=7)) == "as it comes\n"


def test_a_site_is_forgotten_for_as_long_as_its_machine_takes(script: Script) -> None:
    """An emulated one took longer than any other answer may: `terraform destroy` failed for "no orchestrator"."""
    script.answers["DELETE", "/api/v1/sites/lab?drain=true"] = (204, "text/plain", b"")
    script.says("GET", "/api/v1/instances", [])
    script.late = dict.fromkeys(script.answers, 0.4)
    with Client(script.url, timeout=0.05) as client:
        assert client.delete_site("lab", drain=True)
        with pytest.raises(Unreachable):
            client.instances()


def test_a_problem_is_an_error_with_its_sentence(script: Script, client: Client) -> None:
    problem = {"title": "Not found", "status": 404, "detail": "there is no instance 'i1'"}
    script.answers["GET", "/api/v1/instances/i1"] = (404, "application/problem+json", json.dumps(problem).encode())
    with pytest.raises(ApiError) as caught:
        client.get_instance("i1")
    assert str(caught.value) == "there is no instance 'i1'"
    assert caught.value.problem.status == 404


@pytest.mark.parametrize(
    ("status", "content", "sentence"),
    [
        (502, b"<html>", "the answer was HTTP 502: is this the address of an orchestrator?"),
        (302, b"", "the answer was HTTP 302: is this the address of an orchestrator?"),
        (200, b"<html>", "the orchestrator's answer is not understood: has it another version? (no JSON)"),
        (200, b'{"id": 1}', "the orchestrator's answer is not understood: has it another version?"),
    ],
)
def test_an_answer_of_something_else_is_one_sentence(
    script: Script, client: Client, status: int, content: bytes, sentence: str
) -> None:
    script.answers["GET", "/api/v1/instances/i1"] = (status, "text/html", content)
    with pytest.raises(ApiError) as caught:
        client.get_instance("i1")
    assert str(caught.value).startswith(sentence)
    assert "\n" not in str(caught.value)


def test_a_list_that_is_none(script: Script, client: Client) -> None:
    script.says("GET", "/api/v1/instances", {"not": "a list"})
    with pytest.raises(ApiError, match="is not understood"):
        client.instances()


CALLS: list[Callable[[Client], Any]] = [
    lambda c: c.instances(),
    lambda c: c.create_instance(InstanceCreate(robot="r", service="s")),
    lambda c: list(c.watch("i1")),
    lambda c: c.wait_running("i1", timeout=1),
    lambda c: c.create_robot(RobotCreate(name="r")),
    lambda c: c.metrics(),
]


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("url", ["http://127.0.0.1:1", "https://no-such-host.invalid"])
def test_nobody_there_is_one_sentence_that_says_what_to_do(call: Callable[[Client], Any], url: str) -> None:
    with Client(url) as client, pytest.raises(Unreachable) as caught:
        call(client)
    assert str(caught.value) == (
        f"no orchestrator answers at {url}: start one with `skytether orchestrator run`, or correct its address "
        "(--url, or orchestrator in robot.yaml)"
    )


@pytest.mark.parametrize(
    ("token", "sentence"),
    [
        (None, "the orchestrator wants a token; give the operator's or a robot's with --token-file or SKYTETHER_TOKEN"),
        ("sky-0", "not known; give the operator's or a robot's with --token-file or SKYTETHER_TOKEN"),
    ],
)
def test_a_refused_token_says_how_to_give_one_and_nothing_of_headers(
    script: Script, token: str | None, sentence: str
) -> None:
    detail = "not known" if token else "send `Authorization: Bearer TOKEN`"
    script.says("GET", "/api/v1/sites", {"title": "No valid token", "status": 401, "detail": detail}, 401)
    with Client(script.url, token) as client, pytest.raises(ApiError) as caught:
        client.sites()
    assert (caught.value.problem.status, str(caught.value)) == (401, sentence)


@pytest.mark.parametrize("token", ["line\nbreak", "grün", "\0"])
def test_what_cannot_be_a_token_is_refused(token: str) -> None:
    with pytest.raises(ApiError, match="what was given as token is none"):
        Client("http://127.0.0.1:1", token)


def events(*states: str) -> bytes:
    lines = []
    for number, state in enumerate(states, 1):
        data = {"id": number, "instance": "i1", "at": NOW, "state": state, "reason": f"r{number}"}
        lines.append(f"event: state\ndata: {json.dumps(data)}\nid: {number}\n\n")
    return (": ping\n\n" + "".join(lines)).encode()


def test_events_are_read_and_resumed(script: Script, client: Client) -> None:
    path = "/api/v1/instances/i1/events"
    script.answers["GET", path] = (200, "text/event-stream", events("pending", "running", "stopped"))
    seen = list(client.watch("i1", after=5))
    assert [(e.id, e.state) for e in seen] == [(1, "pending"), (2, "running"), (3, "stopped")]
    assert script.asked[0][2]["last-event-id"] == "5"


def test_watching_what_is_not_there(script: Script, client: Client) -> None:
    problem = {"title": "Not found", "status": 404, "detail": "there is no instance 'i1'"}
    script.says("GET", "/api/v1/instances/i1/events", problem, 404)
    with pytest.raises(ApiError, match="there is no instance 'i1'"):
        list(client.watch("i1"))


def test_waiting_gives_the_running_instance_or_says_why_not(script: Script, client: Client) -> None:
    path = "/api/v1/instances/i1/events"
    script.says("GET", "/api/v1/instances/i1", INSTANCE)
    script.answers["GET", path] = (200, "text/event-stream", events("pending", "running"))
    assert client.wait_running("i1", timeout=5).id == "i1"
    script.answers["GET", path] = (200, "text/event-stream", events("pending", "failed"))
    with pytest.raises(NotRunning, match=r"^instance i1 is failed: r2$"):
        client.wait_running("i1", timeout=5)


@contextmanager
def answering(*answers: bytes) -> Iterator[str]:
    """A server that gives these answers, whatever it is asked, and closes the connection after each; its address."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            for answer in answers:
                connection, _ = listener.accept()
                with connection:
                    connection.recv(65536)
                    connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n" + answer)

        thread = threading.Thread(target=serve)
        thread.start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        thread.join()


def test_a_log_is_followed_on_after_its_orchestrator_was_away() -> None:
    document = json.dumps(INSTANCE).encode()
    instance = b"Content-Length: %d\r\n\r\n%s" % (len(document), document)
    cut_off = b"Transfer-Encoding: chunked\r\n\r\n4\r\none\n\r\n"
    said: list[str] = []
    with answering(instance, cut_off, b"Content-Length: 8\r\n\r\none\ntwo\n") as url, Client(url) as client:
        said.extend(client.follow_logs("i1", on_resume=lambda: said.append("again: ")))
    assert "".join(said) == "one\nagain: one\ntwo\n"


@contextmanager
def hanging_up(times: int) -> Iterator[tuple[str, list[bytes]]]:
    """A server that takes requests and closes the connection, so many times; its address, and what it was sent."""
    taken: list[bytes] = []
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            for _ in range(times):
                connection, _ = listener.accept()
                with connection:
                    taken.append(connection.recv(65536))

        thread = threading.Thread(target=serve)
        thread.start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}", taken
        thread.join()


def test_of_several_addresses_the_one_that_answers_is_asked(script: Script) -> None:
    script.says("GET", "/api/v1/instances", [INSTANCE])
    script.says("POST", "/api/v1/robots", {"name": "r", "created_at": NOW, "token": "t"}, 201)
    with Client(f"http://127.0.0.1:1, {script.url}/", "sky-token") as client:
        assert [i.id for i in client.instances()] == ["i1"]
        assert client.create_robot(RobotCreate(name="r")).token == "t"
    with Client("http://127.0.0.1:1,http://127.0.0.1:2") as client, pytest.raises(Unreachable) as caught:
        client.instances()
    assert "answers at http://127.0.0.1:1, http://127.0.0.1:2:" in str(caught.value)


def test_one_that_cannot_serve_now_is_left_for_another(script: Script) -> None:
    problem = {"title": "Not possible now", "status": 503, "detail": "not now"}
    script.says("GET", "/api/v1/instances", problem, 503)
    with Client(f"{script.url},http://127.0.0.1:1") as client, pytest.raises(ApiError, match="not now"):
        client.instances()
    assert len(script.asked) == 2, "once more after the others"


def test_a_lost_connection_is_tried_again_only_where_that_does_no_harm(script: Script) -> None:
    script.says("POST", "/api/v1/instances", INSTANCE, 201)
    with hanging_up(1) as (url, taken), Client(f"{url},{script.url}") as client:
        assert client.create_instance(InstanceCreate(robot="walker", service="toy")).id == "i1"
    (key,) = (line for line in taken[0].lower().splitlines() if line.startswith(b"idempotency-key: "))
    assert key.decode().endswith(script.asked[0][2]["idempotency-key"])
    with hanging_up(1) as (url, _), Client(f"{url},{script.url}") as client, pytest.raises(Unreachable):
        client.create_robot(RobotCreate(name="r"))
    assert len(script.asked) == 1
    with hanging_up(2) as (url, taken), Client(url) as client, pytest.raises(Unreachable):
        client.instances()
    assert len(taken) == 2


def test_no_secret_shows(client: Client) -> None:
    assert "sky-token" not in repr(client) + repr(vars(client))


@pytest.mark.parametrize("url", ["", ",,", "localhost:8600", "cloud", "ftp://cloud:8600", "http://[::1"])
@pytest.mark.parametrize("call", CALLS)
def test_an_address_that_is_none_says_what_to_write(call: Callable[[Client], Any], url: str) -> None:
    with Client(url) as client, pytest.raises(Unreachable, match="is no address of an orchestrator: write http://HOST"):
        call(client)


def test_the_scheme_of_the_other_kind_of_server_is_told(script: Script) -> None:
    secure = script.url.replace("http:", "https:")
    with Client(secure) as client, pytest.raises(Unreachable, match="does not speak TLS: write http://"):
        client.sites()
    with hanging_up(1) as (url, _), Client(url) as client, pytest.raises(Unreachable, match="write https:// instead"):
        client.create_robot(RobotCreate(name="walker"))
