"""One hostile robot among few, for seconds here."""

from __future__ import annotations

from collections import Counter
from math import inf

import pytest

from skytether.lab.bench.hostile import bench_hostile, growth, quantile


@pytest.mark.slow
def test_the_others_notice_nothing_of_a_hostile_robot():
    row = bench_hostile(4, 0.2, lease_s=5)
    assert (row.robots, row.failed, row.ended_wrongly) == (4, 0, 0)
    assert row.renewals > 10
    assert 0 < row.renew_p50_ms <= row.renew_p99_ms <= row.renew_max_ms
    assert row.quiet_p99_ms > 0
    assert 0 < row.served_p99_ms < 5000
    assert 0 < row.refused <= row.attacks
    assert row.memory_growth_mb < 50
    tried = {"names made up", "series made up", "instances", "pattern", "deep JSON", "tokens guessed"}
    tried |= {"another's name", "another's key", "renewals guessed", "another host"}
    assert tried <= row.answers.keys()
    for kind in tried:
        assert {status // 100 for status in row.answers[kind]} <= {0, 4}, kind


def test_memory_grows_from_the_second_quarter_on():
    assert growth([50, 90, 100, 100, 100, 100, 100, 100]) == 0
    assert growth([100, 100, 100, 100, 110, 110, 120, 120]) == 20
    assert growth([100.0]) == 0


def test_a_quantile_of_a_histogram_lies_within_its_bucket():
    counts = Counter({0.01: 50, 0.02: 90, 0.05: 100, inf: 100})
    assert quantile(counts, 0.5) == pytest.approx(0.01)
    assert quantile(counts, 0.7) == pytest.approx(0.015)
    assert quantile(counts, 0.99) == pytest.approx(0.047)
    assert quantile(Counter({0.01: 0, 0.02: 4, inf: 8}), 0.9) == pytest.approx(0.02)
