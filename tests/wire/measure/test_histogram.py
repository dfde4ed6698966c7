"""Quantiles against slow and obvious computations."""

import math

import numpy as np
from deep_size import deep_size
from hypothesis import given
from hypothesis import strategies as st

from skytether.wire.measure.histogram import Histogram


@given(st.lists(st.floats(1e-6, 1e4), min_size=1, max_size=200), st.floats(0, 1), st.integers(0, 200))
def test_quantiles_are_within_one_percent(values, share, together):
    histogram = Histogram()
    histogram.add_all(np.array(values[:together]))
    for value in values[together:]:
        histogram.add(value)
    exact = sorted(values)[max(0, math.ceil(share * len(values) - 1e-9) - 1)]
    assert abs(histogram.quantile(share) / exact - 1) <= 0.0101
    assert (histogram.minimum, histogram.maximum) == (min(values), max(values))


def test_a_histogram_is_bounded_and_takes_anything():
    histogram = Histogram()
    assert math.isnan(histogram.quantile(0.5))
    for exponent in range(-30_000, 30_000):
        histogram.add(10 ** (exponent / 1000))
    histogram.add(-1.0)
    histogram.add_all(np.array([-1.0, 0.0, 1e300]))
    assert deep_size(histogram) < 150_000
