"""What a service answers of its health over HTTP, as a cluster asks it."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import gc
import json
import os
import socket
import threading
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest

from skytether.api.grant import GRANT_VARIABLE, Grant
from skytether.api.service_report import ServiceReport, write_reports
from skytether.service import health_port
from skytether.service.health import SILENT_S
from skytether.service.health_port import answering


@pytest.fixture
def grant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Grant:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    given = Grant(
        instance="i1",
        service="toy",
        robot="walker",
        session_id="00112233445566aa",
        session_key=base64.b64encode(bytes(32)).decode(),
        topics=(),
        ready_file=str(tmp_path / "ready.json"),
        health_port=port,
    )
    (tmp_path / "grant.json").write_text(given.model_dump_json())
    monkeypatch.setenv(GRANT_VARIABLE, str(tmp_path / "grant.json"))
    return given


def ask(grant: Grant, path: str) -> httpx.Response:
    return httpx.get(f"http://127.0.0.1:{grant.health_port}{path}", trust_env=False)


def test_it_is_well_when_it_is_ready_and_its_loop_alive(grant: Grant) -> None:
    ready = Path(str(grant.ready_file))
    with answering(grant):
        assert (ask(grant, "/healthz").status_code, ask(grant, "/healthz").text) == (
            503,
            "the service is not ready: FileNotFoundError",
        )
        ready.write_text("{}")
        assert (ask(grant, "/healthz").status_code, ask(grant, "/healthz").text) == (200, "alive")
        os.utime(ready, (ready.stat().st_mtime - SILENT_S - 5,) * 2)
        assert ask(grant, "/healthz").status_code == 503
        assert "hung" in ask(grant, "/healthz").text
    with pytest.raises(httpx.ConnectError):
        ask(grant, "/healthz")


def test_it_tells_what_was_reported_and_nothing_else(grant: Grant) -> None:
    with answering(grant):
        assert ask(grant, "/reports").json().keys() == {"usage", "trouble"}
        assert ask(grant, "/reports").json()["trouble"] == "the service is not ready: FileNotFoundError"
        report = ServiceReport(1, "no_path", "There is no way to the goal.")
        Path(str(grant.ready_file)).with_name("reports.json").write_bytes(write_reports([report]))
        assert ask(grant, "/reports").json()["reports"][0]["code"] == "no_path"
        for path in ("/", "/grant.json", "/../grant.json", "/healthz/x"):
            assert (ask(grant, path).status_code, ask(grant, path).content) == (404, b"")


def test_one_that_says_nothing_holds_up_nobody_for_long(grant: Grant) -> None:
    Path(str(grant.ready_file)).write_text("{}")
    with answering(grant), socket.create_connection(("127.0.0.1", grant.health_port)):
        assert ask(grant, "/healthz").status_code == 200


def test_strangers_keep_the_cluster_from_no_answer_however_slowly_and_many_they_ask(
    grant: Grant, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(health_port, "TIMEOUT_S", 1.0)
    Path(str(grant.ready_file)).write_text("{}")
    done = threading.Event()

    def drip(strangers: list[socket.socket]) -> None:
        """A request that is never over, of which something comes all the time."""
        while not done.wait(0.2):
            for stranger in strangers:
                with contextlib.suppress(OSError):
                    stranger.sendall(b"x")

    with contextlib.ExitStack() as stack:
        stack.enter_context(answering(grant))
        connect = partial(socket.create_connection, ("127.0.0.1", grant.health_port))
        strangers = [stack.enter_context(connect()) for _ in range(200)]
        for stranger in strangers[:100]:
            with contextlib.suppress(OSError):  # it had to give way already
                stranger.sendall(b"GET /" + b"x" * 20_000)
        dripping = threading.Thread(target=drip, args=(strangers,))
        dripping.start()
        try:
            for _ in range(10):
                assert ask(grant, "/healthz").status_code == 200
            strangers[-1].settimeout(10)
            with contextlib.suppress(ConnectionResetError):
                assert strangers[-1].recv(1) == b""  # the last one, too, has its end
        finally:
            done.set()
            dripping.join()
    assert (caplog.text, *capfd.readouterr()) == ("", "", "")  # nobody fills the service's log


@pytest.mark.filterwarnings("error::ResourceWarning")
def test_who_comes_in_the_moment_of_the_end_is_closed(grant: Grant, monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop sees who comes and that it is to end in one and the same turn."""
    busy, ending = threading.Event(), threading.Event()
    loop, answer = asyncio.new_event_loop(), health_port._Answers._answer  # noqa: SLF001 (holds up the loop)
    tell = loop.call_soon_threadsafe

    def told(*call: Any) -> Any:
        made = tell(*call)
        ending.set()
        return made

    def hold(answers: Any, head: bytes) -> bytes:
        busy.set()
        assert ending.wait(30)
        return answer(answers, head)

    monkeypatch.setattr(loop, "call_soon_threadsafe", told)
    monkeypatch.setattr(asyncio, "new_event_loop", lambda: loop)
    monkeypatch.setattr(health_port._Answers, "_answer", hold)  # noqa: SLF001
    with contextlib.ExitStack() as stack:
        connect = partial(socket.create_connection, ("127.0.0.1", grant.health_port), 10)
        with answering(grant):
            stack.enter_context(connect()).sendall(b"GET /healthz HTTP/1.0\r\n\r\n")
            assert busy.wait(30)
            strangers = [stack.enter_context(connect()) for _ in range(20)]
        gc.collect()
        for stranger in strangers:
            with contextlib.suppress(ConnectionResetError):
                assert stranger.recv(1) == b""


def test_without_a_port_nobody_listens(grant: Grant) -> None:
    quiet = Grant.model_validate(json.loads(grant.model_dump_json()) | {"health_port": 0})
    with answering(quiet), pytest.raises(httpx.ConnectError):
        ask(grant, "/healthz")
