from __future__ import annotations

import dataclasses
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.api.manifest import Needs
from skytether.api.rest import Measurement
from skytether.orchestrator.config.settings import Weights
from skytether.orchestrator.runtimes.base import Capacity
from skytether.orchestrator.scheduling.placement import Candidate, place, score

NEEDS = Needs(cpu=2, memory_mb=512, gpu=1, max_rtt_ms=100, max_loss=0.05, tiers=("edge", "cloud"))
GOOD = Candidate("good", "edge", total=Capacity(4, 4096, 1))


def site(**changes: Any) -> Candidate:
    return dataclasses.replace(GOOD, **changes)


@pytest.mark.parametrize(
    ("candidate", "measured", "reason", "detail", "hopeless"),
    [
        (site(tier="robot"), Measurement(), "tier", "is of tier robot, needed is edge or cloud", True),
        (site(cannot_run="no image"), Measurement(), "runtime", "no image", True),
        (site(), Measurement(rtt_ms=140), "rtt", "round trip measured 140 ms, at most 100 ms allowed", True),
        (site(), Measurement(loss=0.2), "loss", "loss measured 20.0%, at most 5.0% allowed", True),
        (site(total=Capacity(1, 4096, 1)), Measurement(), "cpu", "needs 2 cores, the site has 1", True),
        (site(total=Capacity(4, 256, 1)), Measurement(), "memory", "needs 512 MiB of memory, the site has 256", True),
        (site(total=Capacity(4, 4096, 0)), Measurement(), "gpu", "needs 1 GPUs, the site has 0", True),
        (site(unreachable="away"), Measurement(), "unreachable", "away", False),
        (site(used=Capacity(3, 0)), Measurement(), "cpu", "needs 2 cores, 1 of 4 are free", False),
        (
            site(used=Capacity(0, 4000)),
            Measurement(),
            "memory",
            "needs 512 MiB of memory, 96 of 4096 are free",
            False,
        ),
        (site(used=Capacity(0, 0, 1)), Measurement(), "gpu", "needs 1 GPUs, 0 of 1 are free", False),
    ],
)
def test_each_refusal_has_its_reason_and_number(
    candidate: Candidate, measured: Measurement, reason: str, detail: str, hopeless: bool
) -> None:
    decision = place(NEEDS, {"good": measured}, [candidate])
    assert decision.site is None
    assert [(r.site, r.reason, r.detail) for r in decision.refused] == [("good", reason, detail)]
    assert decision.hopeless is hopeless


def test_limits_themselves_are_good_enough() -> None:
    exact = site(total=Capacity(2, 512, 1))
    assert place(NEEDS, {"good": Measurement(rtt_ms=100, loss=0.05)}, [exact]).site == "good"
    tenths = site(total=Capacity(1, 512, 1), used=Capacity(sum([0.1] * 9), 0))
    assert place(Needs(cpu=0.1), {}, [tenths]).site == "good"


def test_no_site_at_all_is_hopeless() -> None:
    decision = place(NEEDS, {}, [])
    assert decision.site is None
    assert decision.hopeless


def test_one_site_that_is_merely_full_is_hope() -> None:
    decision = place(NEEDS, {}, [site(name="a", tier="robot"), site(name="b", used=Capacity(4, 0))])
    assert decision.site is None
    assert not decision.hopeless


@pytest.mark.parametrize(
    ("sites", "measured", "best"),
    [
        ([site(name="a"), site(name="b")], {"a": Measurement(rtt_ms=20), "b": Measurement(rtt_ms=10)}, "b"),
        ([site(name="a"), site(name="b")], {"b": Measurement(rtt_ms=90)}, "b"),
        ([site(name="a", tier="cloud"), site(name="b")], {}, "b"),
        ([site(name="a", used=Capacity(1, 0)), site(name="b")], {}, "b"),
        ([site(name="b"), site(name="a")], {}, "a"),
    ],
    ids=["lowest round trip", "measured before unmeasured", "nearest tier", "most free processor", "by name"],
)
def test_the_best_site(sites: list[Candidate], measured: dict[str, Measurement], best: str) -> None:
    assert place(NEEDS, measured, sites).site == best


candidates = st.lists(
    st.builds(
        Candidate,
        name=st.sampled_from("abcdef"),
        tier=st.sampled_from(["robot", "edge", "cloud"]),
        unreachable=st.none() | st.just("away"),
        total=st.builds(Capacity, st.floats(0, 4), st.integers(0, 1024), st.integers(0, 2)),
        used=st.builds(Capacity, st.floats(0, 4), st.integers(0, 1024), st.integers(0, 2)),
    ),
    max_size=5,
    unique_by=lambda c: c.name,
)


@settings(max_examples=50, deadline=None)
@given(candidates, st.dictionaries(st.sampled_from("abcdef"), st.builds(Measurement, rtt_ms=st.floats(0, 200))))
def test_every_site_is_chosen_or_refused_in_any_order(sites: list[Candidate], measured: dict[str, Measurement]) -> None:
    decision = place(NEEDS, measured, sites)
    again = place(NEEDS, measured, sites[::-1])
    assert decision.site == again.site
    refused = {r.site for r in decision.refused}
    chosen = next((s for s in sites if s.name == decision.site), None)
    if chosen is None:
        assert refused == {s.name for s in sites}
    else:
        assert chosen.name not in refused
        assert not decision.hopeless
        assert chosen.unreachable is None
        assert chosen.used.cpu + NEEDS.cpu <= chosen.total.cpu + 1e-6


def test_the_score_is_the_delay_of_control_with_what_money_and_crowding_are_worth() -> None:
    needs = Needs(cpu=1, compute_ms=8)
    candidate = Candidate("a", "edge", total=Capacity(4, 4096), used=Capacity(1, 0), speed=2, cost=3)
    reckoned = score(needs, Measurement(rtt_ms=30, jitter_ms=4), candidate, Weights(cost_ms=5, spread_ms=10))
    # Half of the processors are promised with this one: waiting takes as long as computing, 8 ms at double speed.
    assert (reckoned.rtt_ms, reckoned.compute_ms, reckoned.queue_ms) == (34, 4, 4)
    assert (reckoned.cost_ms, reckoned.spread_ms) == (15, 5)
    assert reckoned.total_ms == 62
    assert reckoned.measured


def test_what_is_busy_counts_where_it_is_more_than_what_was_promised() -> None:
    needs = Needs(cpu=1, compute_ms=10)
    candidate = Candidate("a", "edge", total=Capacity(4, 4096), load=0.5)
    assert score(needs, Measurement(), candidate, Weights()).queue_ms == 30  # u = 0.75
    full = dataclasses.replace(candidate, load=1.0)
    assert score(needs, Measurement(), full, Weights()).queue_ms == 190  # u = 0.95 at most


def test_a_dear_site_must_be_faster_by_what_it_costs() -> None:
    near, far = site(name="near", cost=50), site(name="far")
    measured = {"near": Measurement(rtt_ms=10), "far": Measurement(rtt_ms=50)}
    assert place(NEEDS, measured, [near, far], weights=Weights(cost_ms=1)).site == "far"
    decision = place(NEEDS, measured, [near, far], weights=Weights(cost_ms=0.5))
    assert decision.site == "near"
    assert [s.site for s in decision.scores] == ["near", "far"]


def test_images_and_architectures_rule_out() -> None:
    closed = site(images=("registry.example/*",))
    decision = place(NEEDS, {}, [closed], image="evil/image:1")
    assert [(r.reason, r.detail) for r in decision.refused] == [
        ("image", "allows images registry.example/*, asked for is evil/image:1")
    ]
    assert decision.hopeless
    assert place(NEEDS, {}, [closed], image="registry.example/a:1").site == "good"
    arm = site(total=Capacity(4, 4096, 1, "arm64"))
    needs = NEEDS.model_copy(update={"architectures": ("amd64",)})
    decision = place(needs, {}, [arm])
    assert [(r.reason, r.detail) for r in decision.refused] == [("architecture", "is arm64, needed is amd64")]
    assert place(needs, {}, [GOOD]).site == "good"  # not known: the engine will tell


def test_a_site_that_the_robot_prefers_goes_before_others_that_fit_and_only_if_it_fits():
    near, far = site(name="near"), site(name="far")
    measured = {"near": Measurement(rtt_ms=5), "far": Measurement(rtt_ms=50, preferred=True)}
    assert place(NEEDS, measured, [near, far]).site == "far"
    assert place(NEEDS, measured, [near, dataclasses.replace(far, tier="robot")]).site == "near"
