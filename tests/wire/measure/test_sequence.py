"""Sequence gaps against slow and obvious computations."""

from random import Random

from deep_size import deep_size
from hypothesis import given
from hypothesis import strategies as st

from skytether.wire.measure.sequence import SequenceTracker


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
    assert deep_size(tracker) < 200 * tracker.MAX_GAPS
    assert tracker.lost == 4999 - tracker.MAX_GAPS
