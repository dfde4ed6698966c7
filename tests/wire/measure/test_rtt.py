"""The timeout of retransmissions."""

import math

from skytether.wire.measure.rtt import FIRST, LONGEST, RttEstimator


def test_the_timeout_follows_the_round_trip():
    rtt = RttEstimator()
    rtt.add(math.nan)
    assert rtt.timeout == FIRST
    for _ in range(100):
        rtt.add(0.1)
    assert 0.1 < rtt.timeout < 0.13
    for i in range(100):
        rtt.add(0.1 + 0.05 * (i % 2))
    assert rtt.timeout > 0.17
    assert rtt.timeout_after(3) <= LONGEST
    rtt.add(50.0)
    assert rtt.timeout_after(0) > 5
