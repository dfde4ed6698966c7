"""A handful of instances at a made-up cluster, for seconds here."""

from __future__ import annotations

from pathlib import Path

import pytest

from skytether.lab.bench.scale import bench_scale
from skytether.lab.bench.scale_plot import plot_scale


@pytest.mark.slow
def test_each_level_is_measured_and_a_crowd_is_placed(tmp_path: Path):
    found = bench_scale((4, 8), 6, 400, start_s=0.2, idle_s=1.5, asking=3)
    assert [row.instances for row in found.rows] == [4, 8]
    for row in found.rows:
        assert row.started_per_s > 0
        assert row.pass_ms > 0
        assert row.placer_ms > 0
        assert row.memory_mb > 10
        assert row.calls_per_s > 0, "services are asked for their reports"
        assert row.calls_per_s < 400
        assert 0 < row.renew_p50_ms <= row.renew_p99_ms
        assert row.renew_cpu_ms > 0
        assert 0.2 * 0.8 < row.cold_p50_s <= row.cold_p99_s < 30
        assert 0 < row.warm_p50_s <= row.warm_p99_s < 30
    assert found.placements_per_s > 0
    assert found.refused_calls == 0
    plot_scale(found, tmp_path / "scale.png")
    assert (tmp_path / "scale.png").read_bytes()[:4] == b"\x89PNG"
