"""Changing what an instance has under a driven robot, with the real program."""

import pytest

from skytether.lab.bench.pair import BenchError
from skytether.lab.bench.resize import bench_resize


@pytest.mark.slow
def test_a_service_is_given_more_and_less_and_the_robot_is_driven_on():
    row = bench_resize(2, "process")
    assert (row.n, row.restarts, row.runtime) == (2, 0, "process")
    # Shorter than what hands over to the robot's own controller; how short is for the benchmark on a quiet machine.
    assert row.gap_max_periods < 100
    assert row.gap_still_max_periods > 0
    assert 0 < row.resize_p50_s < 10


def test_a_runtime_that_is_not_measured_is_told():
    with pytest.raises(BenchError, match="there are docker, process"):
        bench_resize(1, "kubernetes")
