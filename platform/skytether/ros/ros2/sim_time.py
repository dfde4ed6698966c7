"""The time of a ROS 2 graph, as its nodes stamp messages: that of ``/clock`` where the node uses simulated time."""

from __future__ import annotations

import time
from collections.abc import Callable

from skytether.messages import DecodeError, decode_plain, hash_of

from .dialect import Endpoint, Kind
from .qos import Qos
from .seam import GraphNode, Handle

_LAST = 2.0**31 - 1
"""Seconds: a stamp has no more. Whatever ``/clock`` says, the wheels can be told a velocity, or to brake."""
TOPIC, TYPE = "/clock", "rosgraph_msgs/msg/Clock"


class GraphClock:
    """Seconds, as a node of the graph has them.

    Where our node uses simulated time, it is what ``/clock`` said last, and 0 before it said anything, as for any node
    of ROS 2; else Unix time. ``/clock`` is subscribed once simulated time is used.

    Args:
        node: Ours.
        clock: Unix time in seconds.
    """

    def __init__(self, node: GraphNode, clock: Callable[[], float] = time.time) -> None:
        self._node = node
        self._clock = clock
        self._told = 0.0
        # A hash takes its time, which a velocity that is stamped first must not wait for.
        self._topic = Endpoint(Kind.SUBSCRIPTION, TOPIC, TYPE, hash_of(TYPE, "cdr"), Qos(reliable=False, depth=1))
        self._handle: Handle | None = None

    def __call__(self) -> float:
        if not self._node.sim_time:
            return self._clock()
        if self._handle is None:
            self._handle = self._node.subscribe(self._topic, self._on_clock)
        return self._told

    def close(self) -> None:
        """Leave the graph; the node stays."""
        if self._handle is not None:
            self._handle.close()

    def _on_clock(self, payload: bytes) -> None:
        try:
            told = decode_plain(TYPE, payload).clock
        except DecodeError as error:
            self._node.report(f"clock {TOPIC}", f"{TOPIC}: {error}")
            return
        self._told = min(max(told.sec + told.nanosec / 1e9, 0.0), _LAST)
