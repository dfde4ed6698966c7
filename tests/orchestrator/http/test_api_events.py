from __future__ import annotations

import threading
import time
from typing import Any

import httpx
import pytest
from sqlalchemy.exc import OperationalError

from skytether.api.rest import InstanceCreate, State

ASK = InstanceCreate(robot="walker", service="toy", lease_s=1000)


def test_the_stream_is_server_sent_events(served: Any) -> None:
    served.site()
    operator = served.operator
    made = operator.create_instance(ASK)
    operator.wait_running(made.id, timeout=5)
    operator.delete_instance(made.id)
    url = f"{served.url}/api/v1/instances/{made.id}/events"
    with httpx.stream(
        "GET", url, headers={"Authorization": f"Bearer {served.token}"}, trust_env=False, verify=False
    ) as answer:
        assert answer.headers["content-type"].startswith("text/event-stream")
        text = answer.read().decode()
    first = text.split("\n\n")[0].splitlines()
    assert {line.split(":")[0] for line in first} == {"id", "event", "data"}
    assert "event: state" in first


def test_a_watcher_goes_on_where_it_was(served: Any) -> None:
    served.site()
    operator = served.operator
    made = operator.create_instance(ASK)
    operator.wait_running(made.id, timeout=5)
    seen = []
    for event in operator.watch(made.id, timeout=5):
        seen.append(event)
        if event.state is State.RUNNING:
            break
    operator.delete_instance(made.id)
    rest = list(operator.watch(made.id, after=seen[-1].id, timeout=5))
    assert [e.state for e in rest] == [State.STOPPING, State.STOPPED]
    assert [e.id for e in seen + rest] == sorted(e.id for e in seen + rest)
    assert list(operator.watch(made.id, after=rest[-1].id, timeout=5)) == []


def test_an_event_comes_at_once(served: Any) -> None:
    fake = served.site()
    operator = served.operator
    made = operator.create_instance(ASK)
    operator.wait_running(made.id, timeout=5)
    came: list[float] = []

    def watch() -> None:
        for event in operator.watch(made.id, timeout=5):
            if event.state is State.STARTING and event.reason:
                came.append(time.monotonic())
                return

    thread = threading.Thread(target=watch)
    thread.start()
    crashed = time.monotonic()
    fake.crash(made.id)
    thread.join()
    assert came[0] - crashed < 0.8  # a look at the site, not the second between two looks at the store


def test_watching_ends_with_its_time(served: Any) -> None:
    served.site()
    operator = served.operator
    made = operator.create_instance(ASK)
    operator.wait_running(made.id, timeout=5)
    before = time.monotonic()
    assert [e.state for e in operator.watch(made.id, timeout=0.3)][-1] is State.RUNNING
    assert time.monotonic() - before < 2


def test_watchers_are_let_go_when_the_orchestrator_ends(served: Any) -> None:
    served.site()
    operator = served.operator
    made = operator.create_instance(ASK)
    operator.wait_running(made.id, timeout=5)
    url = f"{served.url}/api/v1/instances/{made.id}/events"
    headers = {"Authorization": f"Bearer {served.token}"}
    with httpx.stream("GET", url, headers=headers, trust_env=False, timeout=10) as answer:
        lines = answer.iter_lines()
        assert next(lines)
        served.core.broker.close()
        list(lines)  # ends, and with it the test


def test_a_stream_goes_on_when_the_database_did_not_answer_for_a_moment(
    served: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    served.site()
    operator, store = served.operator, served.core.store
    made = operator.create_instance(ASK)
    operator.wait_running(made.id, timeout=5)
    events, failed = store.events, threading.Event()

    def gone_once(*asked: Any) -> Any:
        if not failed.is_set():
            failed.set()
            raise OperationalError("SELECT", {}, Exception("gone"))
        return events(*asked)

    url = f"{served.url}/api/v1/instances/{made.id}/events"
    headers = {"Authorization": f"Bearer {served.token}"}
    with httpx.stream("GET", url, headers=headers, trust_env=False, timeout=10) as answer:
        lines = answer.iter_lines()
        assert next(lines)
        monkeypatch.setattr(store, "events", gone_once)
        operator.delete_instance(made.id)
        told = list(lines)
    assert failed.is_set()
    assert '"state":"stopped"' in [line for line in told if line.startswith("data:")][-1]
    assert "Traceback" not in caplog.text
