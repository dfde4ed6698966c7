"""The token bucket."""

from random import Random

import pytest

from skytether.wire.path.pacer import BUCKET_TIME, Pacer


@pytest.mark.parametrize(("rate", "seconds"), [(0.1e6, 2), (5e6, 2), (50e6, 1), (1e9, 0.05)])
def test_over_any_time_no_more_than_rate_and_bucket_is_sent(rate, seconds):
    random, now, sent = Random(1), 0.0, []
    pacer = Pacer(rate, 1200, 19_200, now)
    while now < seconds:
        while pacer.budget(now) > 0:
            size = random.randint(60, 1200)
            pacer.spend(size)
            sent.append((now, size))
        now = max(now + 1e-5, pacer.ready_at(random.choice((1, 1200))))
    assert sum(s for _, s in sent) <= rate / 8 * seconds + pacer.capacity + 1200
    assert sum(s for _, s in sent) >= rate / 8 * seconds * 0.95 - 1200


@pytest.mark.parametrize(("rate", "now"), [(64e3, 1e6), (5e6, 0.1), (3.3e6, 4321.123456), (1e9, 1e5)])
def test_what_it_waits_for_is_there_when_the_wait_is_over(rate, now):
    pacer = Pacer(rate, 1200, 19_200, now)
    pacer.budget(now)
    pacer.spend(int(pacer.capacity) + 50_000)
    due = pacer.ready_at(pacer.quantum)
    assert due > now
    assert pacer.budget(due) >= min(pacer.quantum, pacer.capacity)


def test_a_slow_link_gets_small_bursts():
    # 5 Mbit/s: the bucket holds 3 ms of sending, on slower links a packet, so that hardly ever two wait in the link.
    slow = Pacer(5e6, 1200, 19_200, 0.0)
    assert slow.capacity == pytest.approx(1875)
    assert Pacer(1e6, 1200, 19_200, 0.0).capacity == 1200
    assert slow.quantum == 1250
    assert Pacer(1e9, 1200, 19_200, 0.0).capacity == 1e9 / 8 * BUCKET_TIME


def test_idle_time_is_not_saved_up_and_time_may_stand_still():
    pacer = Pacer(8e6, 1200, 19_200, 10.0)
    assert pacer.budget(100.0) == pacer.capacity
    assert pacer.budget(99.0) == pacer.capacity
