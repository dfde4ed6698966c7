"""The send queue: priority, depth, lifespan, bound."""

from hypothesis import given
from hypothesis import strategies as st

from skytether.wire import Direction, Topic
from skytether.wire.measure.counters import Outbound
from skytether.wire.send.queue import SendQueue
from skytether.wire.state.epoch import SendTopic


def topic(name="t", **options):
    return SendTopic(1, Topic(name, "a/b", Direction.IN, **options), Outbound())


def drain(queue, now=0.0):
    out = []
    while queue.priority >= 0:
        item = queue.pop(now)
        if item is not None:
            out.append((item[0].name, item[1]) if isinstance(item, tuple) else item)
    return out


def test_higher_priorities_leave_first_and_equals_take_turns():
    queue = SendQueue(1000)
    low, a, b = topic("low", priority=1, depth=9), topic("a", priority=5, depth=9), topic("b", priority=5, depth=9)
    for name, where in (("1", low), ("2", a), ("3", a), ("4", b), ("5", b)):
        queue.put(where, name.encode(), 0.0)
    queue.put_other(5, "copy")
    assert queue.priority == 5
    assert drain(queue) == [("a", b"2"), ("b", b"4"), "copy", ("a", b"3"), ("b", b"5"), ("low", b"1")]
    assert queue.used == 0


def test_the_newest_replaces_what_waits():
    queue, t = SendQueue(1000), topic(depth=2)
    for i in range(5):
        queue.put(t, bytes([i]), 0.0)
    assert drain(queue) == [("t", b"\3"), ("t", b"\4")]
    assert t.counters.replaced == 3


def test_what_waited_for_too_long_is_dropped():
    queue, t = SendQueue(1000), topic(depth=9, lifespan=0.1)
    queue.put(t, b"old", 0.0)
    queue.put(t, b"new", 1.0)
    assert drain(queue, now=1.05) == [("t", b"new")]
    queue.put(t, b"old", 0.0)
    assert drain(queue, now=1.0) == []
    assert t.counters.expired == 2
    queue.put(t, b"again", 1.0)
    assert drain(queue, now=1.0) == [("t", b"again")]


def test_the_lowest_priority_gives_way_when_memory_runs_out():
    queue = SendQueue(100)
    low, high = topic("low", priority=1, depth=99), topic("high", priority=9, depth=99)
    for i in range(5):
        queue.put(low, bytes([i]) * 20, 0.0)
    queue.put(high, b"x" * 50, 0.0)
    assert low.counters.replaced == 3
    assert drain(queue) == [("high", b"x" * 50), ("low", b"\3" * 20), ("low", b"\4" * 20)]


@given(
    st.lists(st.tuples(st.integers(0, 3), st.integers(1, 60), st.floats(0, 1), st.booleans()), min_size=1, max_size=100)
)
def test_nothing_is_lost_uncounted_and_the_bound_holds(steps):
    queue = SendQueue(200)
    topics = [topic(f"t{i}", priority=i, depth=1 + i, lifespan=0.3) for i in range(4)]
    offered = taken = 0
    now = 0.0
    for which, size, wait, take in steps:
        now += wait / 10
        queue.put(topics[which], bytes(size), now)
        offered += 1
        assert 0 <= queue.used <= 200
        if take:
            before = queue.priority
            item = queue.pop(now)
            assert item is None or item[0].priority == before
            taken += item is not None
    queue.clear()
    assert queue.used == 0
    assert offered == taken + sum(t.counters.replaced + t.counters.expired for t in topics)
