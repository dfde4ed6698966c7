"""Notes for figures what goes by in a trial: where the robot is, and what passes the network in each second."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from skytether.emulator.udp_link import LinkCounters
from skytether.lab.world.simulation import Robot

from .results import Point, rounded

TRACE_S = 0.1
"""Between two places."""
_SECOND_S = 1.0


class Tracker:
    """Of one robot and one network. Its times are those of the caller.

    Args:
        robot: Whose true place is noted.
        counters: Of the network, by direction (``up``, ``down``).
    """

    def __init__(self, robot: Robot, counters: Callable[[], Mapping[str, LinkCounters]]) -> None:
        self._robot, self._counters = robot, counters
        self._due = self._counted_at = -math.inf
        self._bytes: tuple[int, ...] = ()
        self._kbit: list[list[float]] = [[], [], [], []]
        self.way: list[Point] = []

    def sample(self, now: float) -> bool:
        """Take what is due.

        Args:
            now: [s], not less than before.

        Returns:
            Whether the robot's place was: who notes more does it then.
        """
        if now < self._due:
            return False
        self._due = now + TRACE_S
        self.way.append(rounded(self._robot.pose[:2]))
        if now - self._counted_at >= _SECOND_S:
            found = self._counters()
            ways = (found["up"], found["down"])
            bytes_ = tuple(count for way in ways for count in (way.bytes_received, way.bytes_forwarded))
            if self._bytes:
                took = 125 * (now - self._counted_at)
                for row, before, after in zip(self._kbit, self._bytes, bytes_, strict=True):
                    row.append(round((after - before) / took, 1))
            self._bytes, self._counted_at = bytes_, now
        return True

    def traces(self) -> dict[str, Any]:
        """The fields of `skytether.lab.trial.results.Traces`."""
        names = ("sent_kbit_s", "arrived_kbit_s", "back_sent_kbit_s", "back_arrived_kbit_s")
        return {"way": tuple(self.way), **{name: tuple(row) for name, row in zip(names, self._kbit, strict=True)}}
