"""Successors and standbys, over REST, with runtimes whose failures are staged."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

from skytether.api.client import ApiError
from skytether.api.rest import InstanceCreate, Measurement, Renew, Report, State
from skytether.orchestrator.config.settings import Timing

pytestmark = pytest.mark.slow

QUICK = {"observe": 0.02, "observe_changing": 0.005, "place": 0.02, "stop_grace": 0.1, "backoff": 0.01}


def until(condition: Callable[[], Any]) -> Any:
    limit = time.monotonic() + 30
    while not (found := condition()):
        assert time.monotonic() < limit
        time.sleep(0.01)
    return found


def ask(served: Any, **changes: Any) -> Any:
    body = {"robot": "walker", "service": "toy", "lease_s": 1000, **changes}
    made = served.operator.create_instance(InstanceCreate.model_validate(body))
    return until(lambda: served.running(made.id))


@pytest.fixture
def two(served: Any) -> Any:
    """Two sites, ``near`` and ``far``."""
    for name in ("near", "far"):
        served.site(name, cpu=20)
    served.running = lambda i: (found := served.operator.get_instance(i)).state is State.RUNNING and found
    return served


MEASURED = {"near": Measurement(rtt_ms=5), "far": Measurement(rtt_ms=50)}


def test_an_instance_is_moved_make_before_break(two: Any) -> None:
    first = ask(two, measurements=MEASURED)
    assert first.placement.site == "near"
    second = two.operator.migrate_instance(first.id)
    assert (second.replaces, second.robot) == (first.id, "walker")
    assert two.operator.migrate_instance(first.id).id == second.id  # not twice
    second = until(lambda: two.running(second.id))
    assert second.placement.site == "far"
    assert second.session.id != first.session.id
    renewed = two.operator.renew_instance(first.id)
    assert (renewed.state, renewed.successor) == (State.RUNNING, second.id)
    two.operator.delete_instance(first.id)  # as the robot does, once the second one drives it
    assert two.operator.renew_instance(second.id).successor is None


def test_to_a_site_of_ones_choice_and_what_cannot_be(two: Any) -> None:
    first = ask(two, measurements=MEASURED)
    for site, status, says in (
        ("near", 409, "is at site 'near' already"),
        ("moon", 404, "there is no site 'moon'"),
    ):
        with pytest.raises(ApiError, match=says) as caught:
            two.operator.migrate_instance(first.id, site)
        assert caught.value.problem.status == status
    assert until(lambda: two.running(two.operator.migrate_instance(first.id, "far").id)).placement.site == "far"
    two.operator.delete_instance(first.id)
    until(lambda: two.operator.get_instance(first.id).state.final)
    with pytest.raises(ApiError, match="is stopped: ask for a new one"):
        two.operator.migrate_instance(first.id)


def test_with_no_other_site_nothing_is_started(served: Any) -> None:
    served.site("only")
    made = served.operator.create_instance(InstanceCreate(robot="walker", service="toy", lease_s=1000))
    until(lambda: served.operator.get_instance(made.id).state is State.RUNNING)
    with pytest.raises(ApiError, match="no site can run 'toy': there is no other: add one"):
        served.operator.migrate_instance(made.id)
    assert len(served.operator.instances()) == 1


def test_what_has_no_site_yet_is_not_moved(served: Any, manifest: Any) -> None:
    served.running = lambda i: served.operator.get_instance(i).state is State.RUNNING
    served.site("only", cpu=12)
    put(served, manifest, cpu=8)
    ask(served)
    waiting = served.operator.create_instance(InstanceCreate(robot="walker", service="toy"))
    with pytest.raises(ApiError, match=r"has no site yet \(.+\): move it once it runs") as caught:
        served.operator.migrate_instance(waiting.id)
    assert caught.value.problem.status == 409
    assert len(served.operator.instances()) == 2


def put(served: Any, manifest: Any, **needs: Any) -> None:
    served.operator.put_service("toy", manifest(needs={"cpu": 0.1} | needs, params={"properties": {"n": {}}}))


def standbys(served: Any) -> list[Any]:
    return [i for i in served.operator.instances() if not i.robot and i.state is State.RUNNING]


def test_a_request_gets_the_warm_one_at_once_and_another_is_made(two: Any, manifest: Any) -> None:
    put(two, manifest, standby=1)
    standby = until(lambda: standbys(two))[0]
    body = InstanceCreate(robot="walker", service="toy", lease_s=1000)
    made = two.operator.create_instance(body, idempotency_key="one")
    assert (made.id, made.state, made.robot) == (standby.id, State.RUNNING, "walker")
    assert made.session.port is not None
    assert two.operator.create_instance(body, idempotency_key="one").id == made.id
    other = until(lambda: [s for s in standbys(two) if s.id != made.id])
    assert len(other) == 1
    two.operator.delete_instance(made.id)
    put(two, manifest, standby=0)
    until(lambda: not [i for i in two.operator.instances() if not i.state.final])


def test_a_request_with_other_parameters_starts_its_own(two: Any, manifest: Any) -> None:
    put(two, manifest, standby=1)
    standby = until(lambda: standbys(two))[0]
    made = ask(two, params={"n": 1})
    assert made.id != standby.id
    assert [s.id for s in standbys(two)] == [standby.id]  # parameters that change often do not wear it out


def test_requests_at_once_get_one_each(two: Any, manifest: Any) -> None:
    put(two, manifest, standby=1)
    until(lambda: standbys(two))
    made: list[Any] = []
    body = [InstanceCreate(robot=f"r{n}", service="toy", lease_s=1000) for n in range(8)]
    threads = [threading.Thread(target=lambda b=b: made.append(two.operator.create_instance(b))) for b in body]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({i.id for i in made}) == 8
    assert {i.robot for i in made} == {f"r{n}" for n in range(8)}


def test_when_a_site_falls_silent_the_standby_elsewhere_takes_over(two: Any, manifest: Any) -> None:
    put(two, manifest, standby=1)
    until(lambda: standbys(two))
    first = ask(two)
    standby = until(lambda: [s for s in standbys(two) if s.id != first.id])[0]
    if standby.placement.site == first.placement.site:  # both fit anywhere: have it elsewhere
        two.operator.delete_instance(first.id)
        until(lambda: two.operator.get_instance(first.id).state.final)
        pytest.fail("a standby was put beside what it stands by for")
    two.fleet.made[first.placement.site].silent = True
    successor = until(lambda: two.operator.renew_instance(first.id).successor)
    assert successor == standby.id
    taken = two.operator.get_instance(successor)
    assert (taken.state, taken.robot, taken.replaces) == (State.RUNNING, "walker", first.id)


def test_a_robot_that_drives_by_itself_for_long_is_moved_where_it_is_better(
    served_with: Callable[..., Any], manifest: Any
) -> None:
    served = served_with(timing=Timing(**QUICK, replace_after=0.2, replace_pause=0.1))
    for name in ("near", "far"):
        served.site(name, cpu=20)
    served.running = lambda i: (found := served.operator.get_instance(i)).state is State.RUNNING and found
    first = ask(served, measurements=MEASURED)
    assert first.placement.site == "near"

    def bad() -> Any:
        now_better = {"far": Measurement(rtt_ms=40), "near": Measurement(rtt_ms=300)}
        report = Report(rtt_s=0.3, control_source="fallback")
        return served.operator.renew_instance(first.id, Renew(report=report, measurements=now_better)).successor

    successor = until(bad)
    assert until(lambda: served.running(successor)).placement.site == "far"


def test_a_bad_link_alone_moves_nothing(served_with: Callable[..., Any]) -> None:
    served = served_with(timing=Timing(**QUICK, replace_after=0.05, replace_pause=0.01))
    for name in ("near", "far"):
        served.site(name, cpu=20)
    served.running = lambda i: (found := served.operator.get_instance(i)).state is State.RUNNING and found
    first = ask(served, measurements=MEASURED)
    limit = time.monotonic() + 0.5
    while time.monotonic() < limit:  # both are as bad: nothing would be gained
        same = {"far": Measurement(rtt_ms=300), "near": Measurement(rtt_ms=300)}
        report = Report(rtt_s=0.3, control_source="fallback")
        answer = served.operator.renew_instance(first.id, Renew(report=report, measurements=same))
        assert answer.successor is None


WHY = "its node n1 is cordoned"


def leaves(served: Any, instance: str, why: str = WHY) -> None:
    for runtime in served.fleet.made.values():
        if instance in runtime.world:
            runtime.world[instance].leaving = why


def successor(served: Any, instance: str) -> Any:
    return until(lambda: (found := served.operator.get_instance(instance)).successor and found)


def test_what_its_site_is_about_to_end_is_moved_and_its_site_may_have_another_place(two: Any, manifest: Any) -> None:
    put(two, manifest, cpu=12)  # twice that is more than a site has
    first = ask(two, measurements=MEASURED)
    leaves(two, first.id)
    moving = successor(two, first.id)
    assert (moving.state, moving.placement.site) == (State.RUNNING, "near")
    second = until(lambda: two.running(moving.successor))
    assert second.placement.site == "near"
    until(lambda: two.operator.get_instance(first.id).reason == f"{WHY}: its robot is handed over")
    two.operator.delete_instance(first.id)
    until(lambda: two.operator.get_instance(first.id).state.final)
    two.fleet.made["near"].closed = "no node takes pods"
    leaves(two, second.id)
    third = until(lambda: two.running(successor(two, second.id).successor))
    assert third.placement.site == "far"


def test_what_nothing_else_takes_stays_and_says_why_until_something_does(two: Any) -> None:
    near, far = (two.fleet.made[name] for name in ("near", "far"))
    first = ask(two, measurements=MEASURED)
    near.closed = far.closed = "no node takes pods: n1 is cordoned"
    leaves(two, first.id)
    said = f"{WHY}, and nothing else takes it: far: {far.closed}; near: {near.closed}"
    until(lambda: two.operator.get_instance(first.id).reason == said)
    assert two.running(first.id)
    leaves(two, first.id, "")
    until(lambda: two.operator.get_instance(first.id).reason == "")
    leaves(two, first.id)
    until(lambda: two.operator.get_instance(first.id).reason == said)
    far.closed = ""
    assert until(lambda: two.running(successor(two, first.id).successor)).placement.site == "far"


def test_a_standby_takes_over_from_what_leaves_and_none_is_kept_where_it_would_end(two: Any, manifest: Any) -> None:
    put(two, manifest, standby=1)
    standby = until(lambda: standbys(two))[0]
    leaves(two, standby.id)
    other = until(lambda: [s for s in standbys(two) if s.id != standby.id])[0]
    until(lambda: two.operator.get_instance(standby.id).state.final)
    first = ask(two)
    assert first.id == other.id
    warm = until(lambda: standbys(two))[0]
    leaves(two, first.id)
    assert successor(two, first.id).successor == warm.id
