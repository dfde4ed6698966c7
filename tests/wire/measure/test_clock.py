"""The clock offset's bound always holds."""

from random import Random

from hypothesis import given
from hypothesis import strategies as st

from skytether.wire.measure.clock import MAX_DRIFT, ClockOffset


@given(st.floats(-1e5, 1e5), st.floats(-MAX_DRIFT, MAX_DRIFT), st.integers(0, 2**32))
def test_the_true_offset_is_within_the_stated_error(offset, drift, seed):
    random, clock, now = Random(seed), ClockOffset(), 100.0
    shortest = [9.0, 9.0]
    for _ in range(30):
        now += random.random() * 5
        there, hold, back = (random.expovariate(20) for _ in range(3))
        t2, t3, t4 = now + there, now + there + hold, now + there + hold + back

        def peer(t):
            return t * (1 + drift) + offset

        clock.exchange(now, peer(t2), peer(t3), t4)
        assert abs(clock.offset - (peer(t4) - t4)) <= clock.error + 1e-9
        shortest = [min(shortest[0], there), min(shortest[1], back)]
        # Never worse than the newest exchange alone, and better the more was seen.
        assert clock.error <= (there + back) / 2 + MAX_DRIFT * (there + hold + back) + 1e-9
        now = t4
    assert clock.error <= sum(shortest) / 2 + MAX_DRIFT * 200


def test_before_the_first_exchange_nothing_is_claimed():
    clock = ClockOffset()
    assert not clock.known
    assert clock.error == float("inf")
    assert clock.offset != clock.offset


def test_it_follows_a_clock_that_jumps():
    clock = ClockOffset()
    clock.exchange(1.0, 101.01, 101.01, 1.02)
    clock.exchange(2.0, 202.01, 202.01, 2.02)
    assert abs(clock.offset - 200) <= clock.error <= 0.0101


def test_made_up_times_change_nothing():
    clock = ClockOffset()
    clock.exchange(1.0, 101.01, 101.01, 1.02)
    clock.exchange(2.0, 50.0, 500.0, 2.02)
    assert abs(clock.offset - 100) <= 0.0101
