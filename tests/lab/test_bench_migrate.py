"""Moving a service under a driven robot, with the real program."""

import pytest

from skytether.lab.bench.migrate import bench_migrate


@pytest.mark.slow
def test_a_service_moves_and_the_robot_is_driven_on():
    row = bench_migrate(1)
    assert row.n == 1
    # Shorter than what hands over to the robot's own controller; how short is for the benchmark on a quiet machine.
    assert row.gap_max_ms < 1000
    assert row.gap_still_max_ms > 0
    assert row.gap_start_max_ms > 0
    assert row.move_p50_s > 0
