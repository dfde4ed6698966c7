"""Counters of arrivals: delays, jitter, periods."""

import math

import pytest
from deep_size import deep_size

from skytether.wire.measure.counters import Inbound


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
    assert deep_size(inbound) < 1_000_000
    inbound.settle()
    assert (inbound.delay.total, inbound.period.total) == (100_000, 99_999)
