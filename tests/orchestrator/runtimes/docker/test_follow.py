"""Following an engine that is staged: no engine needed."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from queue import Queue
from types import SimpleNamespace
from typing import Any

import pytest

from skytether.orchestrator.runtimes.base import RuntimeFailure
from skytether.orchestrator.runtimes.docker import follow
from skytether.orchestrator.runtimes.docker.follow import Follower
from skytether.orchestrator.runtimes.docker.objects import INSTANCE, OWNER

PATIENCE = 10.0


class Stream:
    """Events until it is closed."""

    def __init__(self) -> None:
        self._queue: Queue[dict[str, Any] | None] = Queue()

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return iter(self._queue.get, None)

    def tell(self, action: str, container: str) -> None:
        self._queue.put({"Action": action, "Actor": {"ID": container}})

    def close(self) -> None:
        self._queue.put(None)


class StagedEngine:
    """One container, which runs and is not ready until ``ready`` is set; nothing ever happens that is told."""

    base_url, api_version, timeout = "http://engine", "1.41", 1.0

    def __init__(self) -> None:
        self.ready = threading.Event()
        self.looks = Queue[bool]()
        self.streams: list[Stream] = []

    @contextmanager
    def asked(self) -> Iterator[None]:
        yield

    def api(self, _timeout_s: float | None = None) -> StagedEngine:
        return self

    def drop(self) -> None:
        """No connection is held."""

    def info(self) -> dict[str, Any]:
        machine = {"NCPU": 4, "MemTotal": 8 << 30, "Architecture": "x86_64"}
        return {**machine, "SystemTime": "2026-07-24T12:00:00.000000000Z"}

    def containers(self, **_: Any) -> list[dict[str, Any]]:
        return [{"Id": "c1", "Labels": {INSTANCE: "i1"}}]

    def inspect_container(self, _container: str) -> dict[str, Any]:
        labels = {INSTANCE: "i1", OWNER: "me", "skytether.io/attempt": "1", "skytether.io/port": "7600"}
        state = {"Status": "running", "ExitCode": 0, "OOMKilled": False}
        return {
            "Id": "c1",
            "Config": {"Labels": labels},
            "HostConfig": {"Memory": 0},
            "NetworkSettings": {"Ports": {}},
            "Mounts": [],
            "State": state,
        }

    def events(self, **_: Any) -> Stream:
        self.streams.append(Stream())
        return self.streams[-1]

    def stats(self, *_: Any, **__: Any) -> list[Any]:
        return []

    def head(self, *_: Any, **__: Any) -> Any:
        ready = self.ready.is_set()
        self.looks.put(ready)
        return SimpleNamespace(status_code=HTTPStatus.OK if ready else HTTPStatus.NOT_FOUND)


@pytest.fixture
def engine() -> StagedEngine:
    return StagedEngine()


@pytest.fixture
def follower(engine: StagedEngine) -> Iterator[Follower]:
    staged: Any = engine
    made = Follower(staged, "me", lambda: None, 5.0)
    yield made
    made.close()


def test_what_was_started_before_and_is_not_ready_yet_is_seen_to_be_as_soon_as_it_is(
    engine: StagedEngine, follower: Follower
) -> None:
    follower.start()
    assert [seen.ready for seen in follower.seen(PATIENCE)] == [False]
    engine.looks.get(timeout=PATIENCE)  # while it was connected to
    engine.looks.get(timeout=PATIENCE)  # and on, though no event says anything
    engine.ready.set()
    while not engine.looks.get(timeout=PATIENCE):
        pass
    end = time.monotonic() + PATIENCE
    while not follower.seen(PATIENCE)[0].ready:
        assert time.monotonic() < end


def test_what_a_silent_stream_has_not_told_is_found_by_the_next_list_and_only_that_is_looked_at(
    engine: StagedEngine, follower: Follower, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[str] = []
    state = {"State": "running", "Status": "Up 2 minutes"}
    rows = [{"Id": "c1", "Labels": {INSTANCE: "i1"}, **state}]
    inspect = engine.inspect_container

    def inspected(container: str) -> dict[str, Any]:
        looks.append(container)
        found = inspect(container)
        found["State"]["Status"] = rows[0]["State"]
        return found

    monkeypatch.setattr(engine, "containers", lambda **_: rows)
    monkeypatch.setattr(engine, "inspect_container", inspected)
    monkeypatch.setattr(engine, "logs", lambda *_, **__: b"", raising=False)
    engine.ready.set()
    follower.start()
    assert [seen.status for seen in follower.seen(PATIENCE)] == ["running"]

    def silent(times: int) -> None:
        end = time.monotonic() + PATIENCE
        while len(engine.streams) < times:
            assert time.monotonic() < end
            time.sleep(0.005)
        engine.streams[-1].close()

    silent(1)
    silent(2)
    assert looks == ["c1"]
    rows[0] = {**rows[0], "State": "exited", "Status": "Exited (1)"}
    silent(3)
    end = time.monotonic() + PATIENCE
    while follower.seen(PATIENCE)[0].status != "exited":
        assert time.monotonic() < end
        time.sleep(0.005)
    assert looks == ["c1", "c1"]


def test_what_a_container_does_all_the_time_keeps_nobody_from_seeing_the_others(
    engine: StagedEngine, follower: Follower, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One whose processes run out of memory all the time: the end of another was not seen in half a minute."""
    looks = Counter[str]()
    inspect = engine.inspect_container

    def inspected(container: str) -> dict[str, Any]:
        looks[container] += 1
        time.sleep(0.005)
        found = {**inspect(container), "Id": container}
        found["State"]["OOMKilled"] = looks[container] > 2
        return found

    monkeypatch.setattr(engine, "inspect_container", inspected)
    monkeypatch.setattr(follow, "AT_WILL_S", 0.2)
    engine.ready.set()
    follower.start()
    follower.seen(PATIENCE)
    end = time.monotonic() + PATIENCE
    while not engine.streams:
        assert time.monotonic() < end
        time.sleep(0.005)
    for _ in range(1000):
        engine.streams[0].tell("oom", "c1")
        engine.streams[0].tell("health_status: unhealthy", "c1")
    before = looks["c1"]
    engine.streams[0].tell("die", "c2")
    while not looks["c2"]:
        assert time.monotonic() < end
        time.sleep(0.005)
    assert looks["c1"] - before <= 3
    while not next(seen for seen in follower.seen(PATIENCE) if seen.id == "c1").out_of_memory:
        assert time.monotonic() < end, "and the last of it is seen, too"
        time.sleep(0.005)


def test_all_are_listed_now_and_then_though_events_never_cease(
    engine: StagedEngine, follower: Follower, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An engine drops events that are not taken soon, and a stream that is never silent was never begun anew."""
    monkeypatch.setattr(follow, "LIST_S", 0.1)
    engine.ready.set()
    follower.start()
    follower.seen(PATIENCE)
    end = time.monotonic() + PATIENCE
    while len(engine.streams) < 3:
        assert time.monotonic() < end
        for stream in engine.streams[-1:]:
            stream.tell("exec_start", "c1")
        time.sleep(0.02)


def made_up(engine: StagedEngine, monkeypatch: pytest.MonkeyPatch, containers: int) -> None:
    """Have an engine list so many, none of which is ever ready."""
    inspect = engine.inspect_container
    rows = [{"Id": f"c{number}", "Labels": {INSTANCE: "i1"}} for number in range(containers)]
    monkeypatch.setattr(engine, "containers", lambda **_: rows)
    monkeypatch.setattr(engine, "inspect_container", lambda container: {**inspect(container), "Id": container})
    quiet = threading.Event()
    monkeypatch.setattr(engine, "stats", lambda *_, **__: iter(lambda: quiet.wait(0.05) and None, None))


def watchers() -> Counter[str]:
    return Counter(thread.name for thread in threading.enumerate() if thread.name in ("docker-ready", "docker-stats"))


def test_containers_that_an_engine_makes_up_cost_no_thread_each(
    engine: StagedEngine, follower: Follower, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It lists thousands: each had two threads, two connections and a megabyte."""
    monkeypatch.setattr(follow, "BESIDE", 3)
    follower.expect(0)
    made_up(engine, monkeypatch, 40)
    follower.start()
    assert len(follower.seen(PATIENCE)) == 40
    engine.looks.get(timeout=PATIENCE)
    assert max(watchers().values()) <= follow.BESIDE
    follower.expect(10)  # these are to be there, and whoever waited is watched now
    end = time.monotonic() + PATIENCE
    while watchers()["docker-ready"] < 2 * 10 + 3:
        assert time.monotonic() < end
        time.sleep(0.005)
    assert watchers()["docker-ready"] == 2 * 10 + 3


def test_an_engine_that_lists_more_than_there_can_be_is_not_believed(
    engine: StagedEngine, follower: Follower, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(follow, "MOST_LISTED", 39)
    made_up(engine, monkeypatch, 40)
    follower.start()
    with pytest.raises(RuntimeFailure, match="lists 40 containers of this site: that cannot be"):
        follower.seen(PATIENCE)
