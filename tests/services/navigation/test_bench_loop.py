"""The figures of ``skytether lab bench navigation``; that it drives is in `test_drive`."""

import pytest

from skytether.testing.drive import StepTime
from skytether_services.navigation.bench_loop import step_times


def test_times_of_steps_are_told_in_milliseconds() -> None:
    times = step_times([StepTime(wall=i / 1000, cpu=i / 2000) for i in range(101)])
    assert times == pytest.approx(
        {
            "wall_p50_ms": 50,
            "wall_p99_ms": 99,
            "wall_max_ms": 100,
            "cpu_p50_ms": 25,
            "cpu_p99_ms": 49.5,
            "cpu_max_ms": 50,
        }
    )
