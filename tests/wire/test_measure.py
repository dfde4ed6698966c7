"""Quantiles and sequence gaps against slow and obvious computations."""

import math
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.wire.measure import Histogram, Inbound, SequenceTracker


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
    assert len(histogram._counts) <= 1300


@given(st.integers(1, 60), st.integers(0, 2**32))
def test_losses_settle_to_what_never_came(count, seed):
    random, tracker = Random(seed), SequenceTracker(0.1)
    arriving = sorted(s for s in range(count) if random.random() < 0.7)
    arriving.sort(key=lambda s: s + random.randrange(8))
    now, late = 0.0, 0
    for sequence in arriving:
        now += random.random() * 0.05
        tracker.settle(now)
        late += tracker.observe(sequence, now)
        assert tracker.lost >= 0
    tracker.sent(count, now)
    tracker.settle(now + 0.2)
    assert tracker.lost == count - len(arriving)
    assert tracker.received == len(arriving)
    assert tracker.received + tracker.lost == tracker.next == count


def test_a_message_after_its_lifespan_is_late_not_lost():
    tracker = SequenceTracker(0.1)
    tracker.observe(0, 0.0)
    tracker.observe(3, 0.0)
    assert not tracker.observe(2, 0.05)
    tracker.settle(0.2)
    assert tracker.lost == 1
    assert tracker.observe(1, 0.2)
    assert tracker.lost == 0


def test_endless_gaps_are_bounded():
    tracker = SequenceTracker(1e9)
    for i in range(5000):
        tracker.observe(2 * i, 0.0)
    assert len(tracker._gaps) == tracker.MAX_GAPS
    assert tracker.lost == 4999 - tracker.MAX_GAPS


@pytest.mark.parametrize("counted_after", [set(), {1}, {0, 1, 2}])
def test_jitter_with_and_without_reordering(counted_after):
    inbound = Inbound()
    # Sequence 0, 2, 1, 3 with delays 10, 10, 30, 12 ms: by arrival |0| + |20| + |18| over 3; in order |0| + |2| over 2.
    arrivals = (0.0, 0.01, True), (0.1, 0.01, True), (0.11, 0.03, False), (0.2, 0.012, True)
    for i, (now, delay, in_order) in enumerate(arrivals):
        inbound.arrived(delay, 0.001 * i, in_order, now)
        if i in counted_after:
            inbound.settle()
    inbound.settle()
    assert inbound.delay.total == 4
    assert inbound.delay_error == 0.003
    assert math.isclose(inbound.jitter.value, 0.038 / 3)
    assert math.isclose(inbound.jitter_in_order.value, 0.001)
    assert math.isclose(inbound.period.quantile(0.5), 0.09, rel_tol=0.011)


def test_without_a_clock_offset_no_delay_is_made_up():
    inbound = Inbound()
    inbound.arrived(0.0, math.inf, True, 0.0)
    inbound.arrived(0.0, math.inf, True, 0.5)
    inbound.settle()
    assert inbound.delay.total == 0
    assert math.isnan(inbound.delay_error)
    assert inbound.period.total == 1


def test_arrivals_that_nobody_asks_for_are_counted_all_the_same():
    inbound = Inbound()
    for i in range(100_000):
        inbound.arrived(0.01, 0.001, True, i * 0.01)
    assert len(inbound._arrivals) < 10_000
    inbound.settle()
    assert (inbound.delay.total, inbound.period.total) == (100_000, 99_999)
