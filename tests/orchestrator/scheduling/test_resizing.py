"""What running instances have is changed: by hand over REST, by their load, by whoever leads."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
from reconcile_bench import Bench, add

from skytether.api.client import ApiError
from skytether.api.rest import InstanceCreate, Resize, Size, State
from skytether.orchestrator.access.quotas import use_of
from skytether.orchestrator.config.settings import Quotas as QuotaSettings
from skytether.orchestrator.domain.records import Change, Record
from skytether.orchestrator.runtimes.base import OvertakenError, SiteSilentError
from skytether.orchestrator.scheduling.vertical_scaling import CALM_S, PAUSE_S

NewRecord = Callable[..., Record]
TWO = Size(cpu=2, memory_mb=512)


def document(**needs: Any) -> dict[str, Any]:
    spec = {"entrypoint": "skytether.testing.toy_service", "needs": needs}
    return {"apiVersion": "skytether.io/v1", "kind": "Service", "metadata": {"name": "toy"}, "spec": spec}


@pytest.fixture
def running(bench: Any, new_record: NewRecord) -> Callable[..., Bench]:
    """An instance that runs at site ``lab``, and never loses its lease."""

    def make(manifest: dict[str, Any] | None = None, **options: Any) -> Bench:
        b: Bench = bench(**options)
        add(b, new_record(manifest=manifest or document(cpu=1, memory_mb=256), lease_s=1e6, lease_expires_at=2e9))
        b.step(2)
        assert b.record().state is State.RUNNING
        return b

    return make


def want(b: Bench, size: Size, name: str = "i1") -> None:
    resize = {**size.model_dump(), "reason": "asked", "why": "operator asked for it"}
    assert b.store.change(Change(b.record(name), {"resize": resize}), b.clock()) is not None


def told(b: Bench, name: str = "i1") -> list[str]:
    return [reason for _, reason in b.reasons(name) if reason]


def sample(text: str, name: str, **labels: str) -> float | None:
    """Of a metric in Prometheus' text format."""
    for line in text.splitlines():
        found = re.fullmatch(rf"{name}\{{(.*)\}} (\S+)", line)
        if found and all(f'{key}="{value}"' in found[1] for key, value in labels.items()):
            return float(found[2])
    return None


def test_what_it_is_to_have_it_gets_once_and_it_is_told_and_counted(running: Any) -> None:
    b = running()
    want(b, TWO)
    b.step(5)
    record = b.record()
    assert (record.state, record.attempt, record.has, record.resize) == (State.RUNNING, 1, TWO, None)
    assert b.runtime.resized == [("i1", 2.0, 512)]
    assert told(b) == ["has 2 cores and 512 MiB instead of 1 core and 256 MiB: operator asked for it"]
    text = b.metrics.text().decode()
    for resource in ("cpu", "memory"):
        counted = {"resource": resource, "direction": "up", "reason": "asked", "site": "lab", "service": "toy"}
        assert sample(text, "skytether_instance_resizes_total", **counted) == 1.0


def test_room_is_kept_from_when_it_is_asked_for_and_given_back_when_it_is_done(running: Any) -> None:
    b = running(cpu=4, memory_mb=4096)
    want(b, TWO)
    assert b.record().holds == TWO
    assert use_of([b.record()]).cpu == 2
    b.step()
    promised = b.placer.promised()["lab"]
    assert (promised.cpu, promised.memory_mb) == (2, 512)
    want(b, Size(cpu=0.5, memory_mb=128))
    assert b.record().holds == TWO, "until it is done"
    b.step()
    assert b.placer.promised()["lab"].cpu == 0.5


def test_a_run_that_is_started_again_has_the_size_it_had(running: Any, tmp_path: Path) -> None:
    b = running()
    want(b, TWO)
    b.step()
    b.runtime.crash("i1")
    b.restart(tmp_path)
    b.step(4)
    record, launch = b.record(), b.runtime.world["i1"].launch
    assert (record.state, record.attempt, record.has) == (State.RUNNING, 2, TWO)
    assert (launch.spec.needs.cpu, launch.spec.needs.memory_mb) == (2, 512)


def test_a_run_that_crashes_while_it_is_changed_is_changed_when_it_runs_again(running: Any) -> None:
    b = running()
    want(b, TWO)
    b.runtime.crash("i1")
    b.step(4)
    assert (b.record().attempt, b.record().has, b.record().resize) == (2, TWO, None)
    assert [text for text in told(b) if text.startswith("has ")] == [
        "has 2 cores and 512 MiB instead of 1 core and 256 MiB: operator asked for it"
    ]


@pytest.mark.parametrize("done", [False, True])
def test_a_site_that_falls_silent_in_between_is_asked_again_and_it_is_told_once(
    running: Any, monkeypatch: pytest.MonkeyPatch, done: bool
) -> None:
    b = running()
    resize = b.runtime.resize

    def answer_is_lost(*arguments: Any) -> bool:
        if done:
            resize(*arguments)
        raise SiteSilentError("no answer")

    monkeypatch.setattr(b.runtime, "resize", answer_is_lost)
    want(b, TWO)
    b.step(3)
    assert b.record().has == Size(cpu=1, memory_mb=256)
    assert b.record().wants == TWO
    monkeypatch.setattr(b.runtime, "resize", resize)
    b.step(3)
    assert b.record().has == TWO
    assert b.runtime.resized == [("i1", 2.0, 512)]
    assert len(told(b)) == 1


def test_who_leads_next_does_what_the_one_before_did_not_note(running: Any, tmp_path: Path) -> None:
    b = running()
    want(b, TWO)
    b.runtime.resize("i1", 1, b.record().sized(TWO))  # and is killed
    b.restart(tmp_path)
    b.step(3)
    assert b.record().has == TWO
    assert b.runtime.resized == [], "nothing is changed twice"
    assert len(told(b)) == 1


def test_a_leader_that_was_followed_changes_nothing(running: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    b = running()

    def overtaken(*_: Any) -> bool:
        raise OvertakenError("another one leads")

    monkeypatch.setattr(b.runtime, "resize", overtaken)
    want(b, TWO)
    b.step(3)
    assert b.record().wants == TWO
    assert told(b) == []


def test_what_somebody_else_changed_late_is_made_good(running: Any) -> None:
    b = running()
    want(b, TWO)
    b.step()
    b.runtime.resize("i1", 1, b.record().sized(Size(cpu=1, memory_mb=256)))  # a leader that was frozen
    b.clock.forward(6)
    b.step()
    needs = b.runtime.world["i1"].launch.spec.needs
    assert (needs.cpu, needs.memory_mb) == (2, 512)


def test_where_its_site_cannot_another_one_is_started_that_has_it(running: Any, tmp_path: Path) -> None:
    b = running()
    other = b.beside(tmp_path)
    b.runtime.keeps = "its nodes have no room"
    want(b, TWO)
    b.step(2)
    coming = b.record(str(b.store.successor("i1")))
    b.reconciler.site_step(other)
    b.reconciler.site_step(other)
    coming = b.record(coming.id)
    assert (coming.state, coming.site, coming.has) == (State.RUNNING, "lab" if coming.site == "lab" else "other", TWO)
    first = b.record()
    assert (first.state, first.has, first.resize) == (State.RUNNING, Size(cpu=1, memory_mb=256), None)
    says = "site lab does not give it 2 cores and 512 MiB: its nodes have no room: its robot is handed over"
    assert any(text.startswith(says) for text in told(b))


def test_where_nothing_can_it_keeps_what_it_has_and_says_so(running: Any) -> None:
    b = running(cpu=2, memory_mb=600)
    b.runtime.keeps = "its nodes have no room"
    want(b, TWO)
    b.step(3)
    record = b.record()
    assert (record.has, record.resize) == (Size(cpu=1, memory_mb=256), None)
    (text,) = told(b)
    assert text.startswith(
        "site lab does not give it 2 cores and 512 MiB: its nodes have no room, and nothing else takes"
    )
    assert text.endswith("it keeps 1 core and 256 MiB")
    assert b.placer.promised()["lab"].cpu == 1
    assert sample(b.metrics.text().decode(), "skytether_instance_resize_failures_total", site="lab") == 1.0


SCALED = document(cpu=1, memory_mb=256, scaling={"cpu": {"min": 0.5, "max": 4}, "memory_mb": {"min": 128, "max": 1024}})


def play(b: Bench, seconds: float, cores: float, mib: float = 100) -> None:
    """An hour of load in a moment; it gets no more than it has."""
    run = b.runtime.world["i1"]
    for _ in range(round(seconds)):
        b.clock.forward(1.0)
        run = b.runtime.world["i1"]
        run.cpu_s = (run.cpu_s or 0.0) + min(cores, b.record().has.cpu)
        run.memory_bytes = int(mib * 2**20)
        b.step()


def test_its_size_follows_its_load_within_the_bounds_of_its_manifest(running: Any) -> None:
    b = running(SCALED)
    play(b, 40, cores=10, mib=900)
    assert b.record().has == Size(cpu=4, memory_mb=1024)
    assert next(text for text in told(b) if "instead of" in text).endswith("MiB are used")
    play(b, 6 * CALM_S, cores=0.1, mib=50)
    assert 0.5 <= b.record().has.cpu <= 0.6
    assert b.record().has.memory_mb == 128
    assert b.record().attempt == 1
    text = b.metrics.text().decode()
    up = sample(text, "skytether_instance_resizes_total", resource="cpu", direction="up", reason="busy")
    down = sample(text, "skytether_instance_resizes_total", resource="cpu", direction="down", reason="idle")
    assert up
    assert down
    b.step(5)
    assert len(told(b)) <= 14


def test_it_never_gets_more_than_its_site_has_left_and_then_moves_if_another_has_it(
    running: Any, tmp_path: Path
) -> None:
    b = running(SCALED, cpu=2.5, memory_mb=600)
    play(b, 60, cores=10)
    assert b.record().has.cpu == 2.5
    assert told(b)[-1].startswith("is to have 4 cores and 256 MiB, for 2.50 cores are busy, and site lab has no room")
    assert len(told(b)) <= 4, "the same is told once"
    b.beside(tmp_path, cpu=64)
    play(b, 70, cores=10)
    coming = b.record(str(b.store.successor("i1")))
    assert (coming.site, coming.has.cpu) == ("other", 4)


def test_it_never_gets_more_than_its_robot_may_have(running: Any) -> None:
    b = running(SCALED)
    b.left = lambda robot: Size(cpu=3 - b.record().has.cpu, memory_mb=0)
    play(b, 100, cores=10, mib=250)
    assert b.record().has == Size(cpu=3, memory_mb=256)
    assert told(b)[-1].endswith("its robot may have no more")
    assert b.store.successor("i1") is None


def test_at_a_site_that_keeps_sizes_only_more_is_worth_a_move(running: Any) -> None:
    b = running(SCALED)
    b.runtime.keeps = "the cluster is too old"
    play(b, 3 * CALM_S, cores=0.05)
    assert told(b) == []
    play(b, 20 + PAUSE_S, cores=10)
    coming = b.record(str(b.store.successor("i1")))
    assert coming.has.cpu > 1
    assert b.record().resize is None


def test_a_run_that_ran_out_of_memory_has_more_the_next_time_as_far_as_there_is(running: Any) -> None:
    b = running(SCALED, memory_mb=500)

    def runs_out(attempt: int) -> None:
        b.runtime.world["i1"].out_of_memory = True
        b.runtime.crash("i1", -9)
        b.clock.forward(20)
        b.step(4)
        assert (b.record().state, b.record().attempt) == (State.RUNNING, attempt)

    runs_out(2)
    assert b.record().has == Size(cpu=1, memory_mb=384)
    assert b.runtime.world["i1"].launch.spec.needs.memory_mb == 384
    assert told(b)[-1].endswith("with 384 MiB of memory instead of 256")
    runs_out(3)
    assert b.record().has.memory_mb == 496, "what the site has left"
    runs_out(4)
    assert b.record().has.memory_mb == 496
    assert "instead of" not in told(b)[-1]


def test_with_no_room_for_its_size_anywhere_it_has_what_its_manifest_says_and_says_why(
    bench: Any, new_record: NewRecord
) -> None:
    b = bench(cpu=4)
    add(b, new_record(manifest=document(cpu=1, memory_mb=256), size=Size(cpu=8, memory_mb=256).model_dump()))
    b.step(2)
    assert (b.record().state, b.record().has, b.record().size) == (State.RUNNING, Size(cpu=1, memory_mb=256), None)
    assert told(b) == ["has 1 core and 256 MiB instead of 8 cores and 256 MiB: lab: needs 8 cores, the site has 4"]
    assert b.runtime.world["i1"].launch.spec.needs.cpu == 1


# Over REST


def until(condition: Callable[[], Any]) -> Any:
    limit = time.monotonic() + 30
    while not (found := condition()):
        assert time.monotonic() < limit
        time.sleep(0.01)
    return found


def ask(served: Any) -> Any:
    made = served.operator.create_instance(InstanceCreate(robot="walker", service="toy", lease_s=1000))
    return until(lambda: (i := served.operator.get_instance(made.id)).state is State.RUNNING and i)


def refused(served: Any, instance: str, **asked: Any) -> tuple[int, str]:
    with pytest.raises(ApiError) as caught:
        served.operator.resize_instance(instance, Resize(**asked))
    return caught.value.problem.status, str(caught.value)


def test_by_hand_it_is_given_more_and_less_and_says_what_it_has(served: Any) -> None:
    fake = served.site(cpu=8, memory_mb=4096)
    made = ask(served)
    assert (made.size, made.resize) == (Size(cpu=0.1, memory_mb=128), None)
    answer = served.operator.resize_instance(made.id, Resize(cpu=2))
    assert answer.resize in (Size(cpu=2, memory_mb=128), None)
    shown = until(lambda: (i := served.operator.get_instance(made.id)).size.cpu == 2 and i)
    assert (shown.size, shown.resize, shown.restarts) == (Size(cpu=2, memory_mb=128), None, 0)
    assert served.operator.resize_instance(made.id, Resize(cpu=2)).size == shown.size, "asked for again"
    served.operator.resize_instance(made.id, Resize(cpu=0.05, memory_mb=64))
    until(lambda: served.operator.get_instance(made.id).size == Size(cpu=0.05, memory_mb=64))
    assert fake.resized == [(made.id, 2.0, 128), (made.id, 0.05, 64)]
    text = served.operator.metrics()
    assert sample(text, "skytether_instance_promised_cpu_cores", robot="walker") == 0.05
    assert sample(text, "skytether_site_promised_cpu_cores", site="lab") == 0.05
    assert sample(text, "skytether_robot_promised_memory_bytes", robot="walker") == 64 * 2**20


def test_what_cannot_be_is_told_in_a_sentence_and_nothing_is_changed(served: Any) -> None:
    fake = served.site(cpu=8, memory_mb=4096)
    made = ask(served)
    fake.world[made.id].memory_bytes = 100 << 20
    until(lambda: served.core.sites.find("lab").observed[made.id].memory_bytes == 100 << 20)
    for asked, status, says in (
        ({"cpu": 12}, 409, "lab: needs 12 cores, the site has 8"),
        ({"memory_mb": 5000}, 409, "lab: needs 5000 MiB of memory, the site has 4096"),
        ({"memory_mb": 64}, 422, "memory_mb is 64, and it uses 100 MiB now: give it 132 at least"),
        ({"cpu": 16, "memory_mb": 16}, 422, "memory_mb is 16"),
    ):
        got, text = refused(served, made.id, **asked)
        assert (got, says in text.replace("memory_mb: is", "memory_mb is")) == (status, True), text
    assert refused(served, "nobody", cpu=1)[0] == 404
    for body in ({}, {"cpu": -1}, {"memory_mb": 0.5}, {"cpu": "many"}, {"cores": 2}):
        asked_for = httpx.patch(
            f"{served.url}/api/v1/instances/{made.id}", json=body, headers={"Authorization": f"Bearer {served.token}"}
        )
        assert asked_for.status_code == 422
    assert served.operator.get_instance(made.id).size == made.size
    assert fake.resized == []
    with pytest.raises(ApiError, match="needs an operator's token"):
        served.robot().resize_instance(made.id, Resize(cpu=1))
    served.operator.delete_instance(made.id)
    until(lambda: served.operator.get_instance(made.id).state.final)
    assert refused(served, made.id, cpu=1) == (409, f"instance '{made.id}' is stopped: ask for a new one")


def test_a_robot_s_quota_holds_and_the_policy_s_bounds(served_with: Any, manifest: Any) -> None:
    served = served_with(quotas=QuotaSettings(robot_cpu=3, robot_memory_mb=1000))
    served.site(cpu=64, memory_mb=64_000)
    scaling = {"cpu": {"min": 0.5, "max": 6}}
    served.operator.put_service("toy", manifest(needs={"cpu": 1, "scaling": scaling}))
    made = ask(served)
    says = "cpu: is 8, and the service's needs.scaling.cpu goes from 0.5 to 6"
    assert refused(served, made.id, cpu=8) == (422, says)
    says = "robot 'walker' would have 4 cores, and may have 3 (quotas.robot_cpu): let one end first"
    assert refused(served, made.id, cpu=4) == (409, says)
    says = "robot 'walker' would have 1001 MiB of memory, and may have 1000 (quotas.robot_memory_mb): let one end first"
    assert refused(served, made.id, memory_mb=1001) == (409, says)
    assert served.operator.resize_instance(made.id, Resize(cpu=3)).id == made.id
    until(lambda: served.operator.get_instance(made.id).size.cpu == 3)


def test_with_no_room_there_its_robot_is_handed_over_to_where_there_is(served: Any) -> None:
    served.site("small", cpu=1)
    made = ask(served)
    served.site("large", cpu=16)
    answer = served.operator.resize_instance(made.id, Resize(cpu=4))
    assert (answer.id, answer.size) == (made.id, made.size)
    coming = until(lambda: (i := served.operator.get_instance(answer.successor)).state is State.RUNNING and i)
    assert (coming.placement.site, coming.size.cpu, coming.replaces) == ("large", 4, made.id)
    assert refused(served, made.id, cpu=5)[0] == 409
    assert served.operator.migrate_instance(made.id).id == coming.id


def test_a_silent_site_is_not_asked_and_one_that_falls_silent_is_asked_later(served: Any) -> None:
    fake = served.site(cpu=8)
    made = ask(served)
    fake.silent = True
    until(lambda: served.operator.get_site("lab").state == "unreachable")
    assert refused(served, made.id, cpu=2)[0] == 503
    fake.silent = False
    until(lambda: served.operator.get_site("lab").state == "ready")
    served.operator.resize_instance(made.id, Resize(cpu=2))
    until(lambda: served.operator.get_instance(made.id).size.cpu == 2)


def test_a_move_by_hand_takes_the_size_along(served: Any) -> None:
    served.site("near", cpu=8)
    served.site("far", cpu=8)
    made = ask(served)
    served.operator.resize_instance(made.id, Resize(cpu=2, memory_mb=256))
    until(lambda: served.operator.get_instance(made.id).size.cpu == 2)
    assert served.operator.migrate_instance(made.id).size == Size(cpu=2, memory_mb=256)


def test_a_standby_that_takes_over_gets_the_size_that_was_there(served: Any, manifest: Any) -> None:
    fake = served.site(cpu=16)
    served.operator.put_service("toy", manifest(needs={"cpu": 1, "standby": 1}))

    def warm() -> Any:
        there = served.operator.instances()
        return next((i.id for i in there if not i.robot and i.state is State.RUNNING), None)

    until(warm)
    made = ask(served)
    served.operator.resize_instance(made.id, Resize(cpu=2))
    until(lambda: served.operator.get_instance(made.id).size.cpu == 2)
    standby = until(warm)
    fake.crash(made.id)
    until(lambda: served.operator.get_instance(made.id).successor == standby)
    coming = until(lambda: (i := served.operator.get_instance(standby)).size.cpu == 2 and i)
    assert (coming.replaces, coming.restarts) == (made.id, 0)
    events = [event.reason for event in served.core.store.events(standby, 0)]
    assert events[-1].endswith(f"instead of 1 core and 128 MiB: instance {made.id} had that")
