import json
import subprocess
import sys

import pytest

from skytether.lab.bench.failover import bench_failover


def test_a_rate_out_of_range_is_refused():
    with pytest.raises(ValueError, match="rate: must be above 1"):
        bench_failover([0.5], 1)


@pytest.mark.slow
def test_cuts_are_timed_between_real_processes_and_printed():
    # How fast it is, the benchmark says where it is run for that; here a busy machine may take its time.
    command = [sys.executable, "-m", "skytether.cli", "lab", "bench", "failover", "--json"]
    command += ["-n", "2", "--rate", "100", "--rate", "10"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=180)
    rows = json.loads(result.stdout)
    assert [row["rate_hz"] for row in rows] == [100, 10]
    assert [row["bound_ms"] for row in rows] == [200, 200]
    for row in rows:
        assert row["n"] == 2
        assert 0 < row["cut_to_local_p50_ms"] <= row["cut_to_local_p99_ms"] <= row["cut_to_local_max_ms"] < 5000
        assert 0 < row["velocity_jump_max_m_s"] <= 0.1 + 1e-9  # 2 m/s^2 for the 50 ms that a step counts at most
    missed = any(row["cut_to_local_max_ms"] > row["bound_ms"] for row in rows)
    assert result.returncode == missed
