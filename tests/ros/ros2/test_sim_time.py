"""The time of a graph, of what ``/clock`` says."""

from types import SimpleNamespace

import pytest

from skytether.messages import Time, encode_plain
from skytether.ros.ros2.sim_time import TYPE, GraphClock


@pytest.mark.parametrize(
    ("sec", "nanosec", "told"),
    [(5, 500_000_000, 5.5), (0, 0, 0.0), (-5, 0, 0.0), (2**31 - 1, 2**32 - 1, 2.0**31 - 1)],
)
def test_whatever_the_clock_says_is_a_stamp(sec, nanosec, told):
    """Of one that was none no velocity could be made, nor a standstill: the wheels were told nothing."""
    takes = []
    node = SimpleNamespace(sim_time=True, subscribe=lambda _endpoint, take: takes.append(take))
    clock = GraphClock(node)
    assert clock() == 0.0
    takes[0](encode_plain(TYPE, {"clock": {"sec": sec, "nanosec": nanosec}}, "cdr"))
    assert clock() == told
    Time.from_seconds(clock())
