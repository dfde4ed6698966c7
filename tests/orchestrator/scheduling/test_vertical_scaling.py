"""How much an instance should have, by what it takes: made-up time, made-up loads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.api.manifest import Needs, Scaling, ServiceSpec
from skytether.api.rest import Size
from skytether.orchestrator.runtimes.base import least_memory_mb
from skytether.orchestrator.scheduling.vertical_scaling import (
    AIM_CPU,
    BUSY,
    CALM_S,
    CORES,
    GROWTH,
    HOLD_S,
    PAUSE_S,
    ROOM_MB,
    WINDOW_S,
    InstanceSample,
    Proposal,
    Trend,
    bounded,
    decide,
)

CPU = Scaling(cpu={"min": 0.25, "max": 4})
MEMORY = Scaling(memory_mb={"min": 64, "max": 2048})
REACTION_S = WINDOW_S + HOLD_S + 2.0
"""With two seconds between two readings."""


@dataclass
class Played:
    """An instance whose load is made up, looked at once a second."""

    scaling: Scaling
    size: Size = field(default_factory=lambda: Size(cpu=1, memory_mb=256))
    every_s: float = 1.0
    """Between two readings of processor time."""
    now: float = 1000.0
    cpu_s: float = 0.0
    told: InstanceSample = field(default_factory=InstanceSample)
    trend: Trend | None = None
    changes: list[tuple[float, Proposal]] = field(default_factory=list)

    def run(self, seconds: float, cores: float = 0.0, mib: float = 0.0, step_s: float | None = None) -> Played:
        """``cores`` are wanted; it gets no more than it has, or one."""
        for _ in range(round(seconds)):
            self.now += 1.0
            self.cpu_s += min(cores, max(1.0, self.size.cpu))
            if self.now % self.every_s == 0:
                self.told = InstanceSample(self.cpu_s, int(mib * 2**20), step_s)
            self.trend, proposed = decide(self.scaling, self.size, self.trend, self.told, self.now)
            if proposed is not None:
                self.changes.append((self.now, proposed))
                self.size = proposed.size
        return self


def test_cores_that_are_busy_become_more_within_seconds_and_the_reason_is_told() -> None:
    played = Played(CPU, every_s=2.0).run(60, cores=0.5)
    assert played.changes == []
    began = played.now
    played.run(60, cores=2.0)
    at, first = played.changes[0]
    assert at - began <= REACTION_S
    assert first.reason == "busy"
    assert "cores are busy" in first.why
    assert 2.0 / BUSY <= played.size.cpu <= 2.0 / AIM_CPU + CORES, "enough for what it wants"


def test_a_steady_load_is_answered_once_and_then_left() -> None:
    played = Played(CPU).run(600, cores=0.9)
    assert len(played.changes) == 1
    played.run(3600, cores=0.9)
    assert len(played.changes) == 1


def test_it_shrinks_only_after_a_calm_minute_and_not_below_what_was_used_meanwhile() -> None:
    played = Played(CPU, Size(cpu=4, memory_mb=256)).run(CALM_S - 1, cores=0.5)
    assert played.changes == []
    played.run(10, cores=1.0)
    assert [change.reason for _, change in played.changes] == ["idle"]
    assert played.size.cpu == 2.0, "by half at most"
    played.run(600, cores=0.5)
    assert played.size.cpu == pytest.approx(0.85)
    assert len(played.changes) <= 3


def test_a_load_that_comes_and_goes_does_not_make_it_flap() -> None:
    played = Played(CPU)
    for _ in range(60):
        played.run(30, cores=1.5).run(90, cores=0.2)
    reversals = sum(
        (one.size.cpu > two.size.cpu) != (two.size.cpu > three.size.cpu)
        for (_, one), (_, two), (_, three) in zip(played.changes, played.changes[1:], played.changes[2:], strict=False)
    )
    assert reversals <= 14, "each time it proved too small it waits for twice as long"
    assert [at for at, _ in played.changes][-1] - 1000 < 7200


def test_steps_that_take_too_long_get_more_cores_though_these_are_not_busy() -> None:
    scaling = Scaling(cpu={"min": 0.5, "max": 4}, step_ms=10)
    played = Played(scaling).run(30, cores=0.5, step_s=0.004)
    assert played.changes == []
    played.run(15, cores=0.5, step_s=0.012)
    (_, change), *_ = played.changes
    assert (change.reason, change.size.cpu) == ("slow", 1.5)
    assert change.why == "19 of 20 steps take up to 12 ms, and may take 10 ms"
    before = played.size
    played.run(600, cores=0.1, step_s=0.008)
    assert played.size == before, "idle, but with fewer its steps might be too long"
    played.run(600, cores=0.1, step_s=0.002)
    assert played.size.cpu <= 0.6


def test_memory_grows_before_it_is_full_and_leaves_room_when_it_shrinks() -> None:
    played = Played(MEMORY).run(30, mib=190)
    assert played.changes == []
    began = played.now
    played.run(10, mib=230)
    at, change = played.changes[0]
    assert at - began <= HOLD_S + 1
    assert (change.reason, change.why) == ("memory", "230 MiB are used")
    assert change.size.memory_mb == 368
    played.run(300, mib=20)
    assert played.size.memory_mb == 64
    assert played.size.memory_mb >= 20 + ROOM_MB


def test_the_bounds_hold_whatever_happens() -> None:
    played = Played(Scaling(cpu={"min": 0.5, "max": 2}, memory_mb={"min": 128, "max": 512}))
    played.run(300, cores=50, mib=5000)
    assert played.size == Size(cpu=2, memory_mb=512)
    played.run(3600)
    assert played.size == Size(cpu=0.5, memory_mb=128)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.integers(1, 90), st.floats(0, 8), st.floats(0, 3000)), min_size=1, max_size=15),
    st.sampled_from([1.0, 2.0, 15.0]),
)
def test_changes_are_bounded_in_size_and_rate(loads: list[tuple[int, float, float]], every_s: float) -> None:
    scaling = Scaling(cpu={"min": 0.25, "max": 6}, memory_mb={"min": 64, "max": 2048})
    played = Played(scaling, every_s=every_s)
    for seconds, cores, mib in loads:
        played.run(seconds, cores, mib)
    before, changed = Size(cpu=1, memory_mb=256), {"cpu": 0.0, "memory_mb": 0.0}
    for at, change in played.changes:
        for key, (least, most) in {"cpu": (0.25, 6), "memory_mb": (64, 2048)}.items():
            old, new = getattr(before, key), getattr(change.size, key)
            assert least <= new <= most
            if new != old:
                assert old / GROWTH - 1e-6 <= new <= old * GROWTH + 1e-6
                assert at - changed[key] >= PAUSE_S
                changed[key] = at
        assert change.size != before
        before = change.size


def test_readings_that_come_every_fifteen_seconds_are_not_taken_for_bursts() -> None:
    played = Played(CPU, every_s=15.0).run(900, cores=0.6)
    assert played.changes == []
    played.run(120, cores=3.0)
    assert played.size.cpu >= 3.0


def test_another_run_counts_from_zero_and_a_change_by_hand_rests() -> None:
    played = Played(CPU).run(30, cores=0.5)
    _, proposed = decide(CPU, played.size, played.trend, InstanceSample(0.0, attempt=2), played.now + 1)
    assert proposed is None
    by_hand = Size(cpu=0.5, memory_mb=256)
    trend = played.trend
    for second in range(1, int(PAUSE_S)):
        trend, proposed = decide(CPU, by_hand, trend, InstanceSample(played.cpu_s + second), played.now + second)
        assert proposed is None


def test_nothing_is_decided_by_what_is_not_known() -> None:
    trend = None
    for second in range(600):
        trend, proposed = decide(CPU, Size(cpu=4, memory_mb=256), trend, InstanceSample(), float(second))
        assert proposed is None


@pytest.mark.parametrize(
    ("room", "gets"),
    [
        (Size(cpu=10, memory_mb=10_000), Size(cpu=3, memory_mb=512)),
        (Size(cpu=0.53, memory_mb=100), Size(cpu=1.5, memory_mb=352)),
        (Size(cpu=-2, memory_mb=-50), Size(cpu=1, memory_mb=256)),
    ],
)
def test_it_gets_no_more_than_there_is_room_for(room: Size, gets: Size) -> None:
    assert bounded(Size(cpu=3, memory_mb=512), Size(cpu=1, memory_mb=256), room) == gets


def test_what_is_given_back_needs_no_room() -> None:
    less, nothing = Size(cpu=0.5, memory_mb=128), Size(cpu=0, memory_mb=0)
    assert bounded(less, Size(cpu=1, memory_mb=256), nothing) == less


@pytest.mark.parametrize(("used_mb", "least"), [(0, 32), (100, 132), (1000, 1100)])
def test_memory_is_not_brought_below_what_is_used(used_mb: int, least: int) -> None:
    assert least_memory_mb(used_mb << 20) == least


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Scaling(cpu={"min": 4, "max": 2}), "scaling.cpu: min is 4, above max, 2"),
        (lambda: Scaling(memory_mb={"min": 4, "max": 2}), "scaling.memory_mb: min is 4, above max, 2"),
        (lambda: Scaling(), "say what follows the load"),
        (lambda: Scaling(memory_mb={"min": 1, "max": 2}, step_ms=5), "say with scaling.cpu how many"),
        (
            lambda: Needs(cpu=0.1, scaling={"cpu": {"min": 0.5, "max": 2}}),
            "cpu is 0.1, and scaling.cpu goes from 0.5 to 2",
        ),
        (
            lambda: ServiceSpec(
                entrypoint="m", needs={"cpu": 1, "scaling": {"cpu": {"min": 1, "max": 4}}}, limits={"cpu": 2}
            ),
            "limits.cpu is 2, less than needs.scaling.cpu.max, 4",
        ),
    ],
)
def test_bounds_that_make_no_sense_are_told(make: Callable[[], Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        make()


def test_a_size_raises_the_limits_that_are_below_it_and_nothing_else() -> None:
    spec = ServiceSpec(entrypoint="m", needs={"cpu": 1, "gpu": 1}, limits={"cpu": 2, "pids": 99})
    sized = spec.sized(0.5, 64)
    assert (sized.needs.cpu, sized.needs.memory_mb, sized.needs.gpu) == (0.5, 64, 1)
    assert (sized.limits.cpu, sized.limits.memory_mb, sized.limits.pids) == (2, None, 99)
    assert spec.sized(3, 64).limits.cpu == 3
