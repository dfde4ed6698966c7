import math
from itertools import pairwise

import numpy as np
import pytest

from skytether.lab.measures import Judge, Sample, kinematic_tracking_error, measure
from skytether.lab.trail import Trail
from skytether.robot.control.command import Source

STRAIGHT = Trail([{"length": 4.0}])


def walk(*points: tuple[float, float], speed: float = 0.2, source: Source = Source.CLOUD) -> list[Sample]:
    """Along the points at a constant speed, sampled every 10 ms."""
    samples, time = [], 0.0
    for (x0, y0), (x1, y1) in pairwise(points):
        count = round(math.hypot(x1 - x0, y1 - y0) / speed / 0.01)
        for i in range(count):
            samples.append(Sample(time, x0 + (x1 - x0) * i / count, y0 + (y1 - y0) * i / count, source))
            time += 0.01
    return [*samples, Sample(time, *points[-1], source)]


def test_equation_5_1() -> None:
    # mean 0.2, variance ((0.1)^2 + 0 + (0.1)^2) / 3
    assert kinematic_tracking_error(np.array([0.1, 0.2, 0.3])) == pytest.approx(math.sqrt(0.04 + 0.02 / 3))


def test_tracking_error_is_the_same_with_signed_and_with_absolute_errors() -> None:
    errors = np.array([-0.3, 0.1, 0.2, -0.05])
    assert kinematic_tracking_error(errors) == pytest.approx(kinematic_tracking_error(np.abs(errors)))


def test_a_walk_beside_the_trail() -> None:
    result = measure(walk((0, 0.1), (4, 0.1)), STRAIGHT)
    assert result.completed
    assert result.time_s == pytest.approx(3.9 / 0.2, abs=0.02)
    assert result.mean_speed_m_s == pytest.approx(0.2, rel=1e-3)
    assert result.kte_m == pytest.approx(0.1)
    assert result.deviation_max_m == pytest.approx(0.1)


def test_standing_still_does_not_weigh_in_the_tracking_error() -> None:
    moving = walk((0, 0), (2, 0), (2, 0.2), (4, 0.2))
    there = next(i for i, s in enumerate(moving) if s.y >= 0.2)
    waiting = [
        *moving[:there],
        *(Sample(moving[there].time + i * 0.01, 2, 0.2, Source.STOP) for i in range(1000)),
        *(s._replace(time=s.time + 10) for s in moving[there:]),
    ]
    assert measure(waiting, STRAIGHT).kte_m == pytest.approx(measure(moving, STRAIGHT).kte_m, abs=1e-4)
    assert measure(waiting, STRAIGHT).time_s == pytest.approx(measure(moving, STRAIGHT).time_s + 10)


def test_standing_still_does_not_weigh_after_a_long_stride_between_two_samples() -> None:
    strides = [Sample(i, 0.2 * i, 0.1 * (i % 2), Source.CLOUD) for i in range(12)]
    waiting = [Sample(11 + i, 2.2, 0.1, Source.STOP) for i in range(1, 200)]
    assert measure([*strides, *waiting], STRAIGHT).kte_m == pytest.approx(measure(strides, STRAIGHT).kte_m)


def test_seconds_of_each_source() -> None:
    samples = [s._replace(source=Source.FALLBACK if 1 <= s.x < 2 else Source.CLOUD) for s in walk((0, 0), (4, 0))]
    seconds = measure(samples, STRAIGHT).source_s
    assert seconds[Source.FALLBACK] == pytest.approx(5.0, abs=0.02)
    assert seconds[Source.CLOUD] == pytest.approx(2.9 / 0.2, abs=0.03)
    assert seconds[Source.STOP] == 0


@pytest.mark.parametrize(
    "points",
    [
        [(0, 0), (3.8, 0)],  # stopped short
        [(0, 0), (0, 1), (4, 1), (4, 0)],  # round it
        [(4, 0), (3.9, 0)],  # its end alone
    ],
)
def test_a_trail_not_passed_is_not_completed(points: list[tuple[float, float]]) -> None:
    result = measure(walk(*points), STRAIGHT)
    assert not result.completed
    assert result.time_s == pytest.approx(walk(*points)[-1].time)


def test_needs_a_sample() -> None:
    with pytest.raises(ValueError, match="no samples"):
        measure([], STRAIGHT)
    assert measure([Sample(0, 0, 0, Source.STOP)], STRAIGHT).mean_speed_m_s == 0


def test_judges_while_the_walk_goes_on_and_no_further_than_the_end() -> None:
    judge = Judge(STRAIGHT)
    samples = walk((0, 0.1), (4, 0.1), (4, 3))
    for sample in samples[:1000]:
        judge.add(sample)
    assert not judge.completed
    assert judge.s == pytest.approx(2.0, abs=0.01)
    assert judge.result().time_s == pytest.approx(9.99)
    for sample in samples[1000:]:
        judge.add(sample)
    assert judge.result() == measure(walk((0, 0.1), (4, 0.1)), STRAIGHT)
