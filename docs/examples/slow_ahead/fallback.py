"""Straight on, slowly, while the laser sees room ahead."""

from collections.abc import Mapping

import numpy as np

from skytether.control.admittance import Velocity
from skytether.messages import LaserScan
from skytether.robot.control.fallback import Reading


class SlowAhead:
    """What this robot does when link or service are not good enough.

    Args:
        speed: While the way is free [m/s].
        room: To leave ahead [m].
    """

    drives = True

    def __init__(self, speed: float = 0.1, room: float = 0.6) -> None:
        """Raises ValueError for options that make no sense: the robot's owner reads the text."""
        if not (0 < speed <= 0.5 and room > 0):
            raise ValueError("speed must be above 0 and at most 0.5 m/s, and room above 0 m")
        self._speed, self._room = speed, room

    def step(self, _velocity: Velocity, readings: Mapping[str, Reading], _dt: float) -> tuple[Velocity, float] | None:
        """One tick in charge: the velocity wanted, and when what it is based on was read. None: stop."""
        scan = readings.get("scan")
        if scan is None or not isinstance(scan.message, LaserScan):
            return None
        free = ahead(scan.message) - self._room
        return Velocity(min(self._speed, max(free, 0.0)), 0.0), scan.read_at


def ahead(scan: LaserScan) -> float:
    """Metres to the nearest thing within 20 degrees of straight on; 0 where the laser does not know."""
    angles = scan.angle_min + scan.angle_increment * np.arange(scan.ranges.size)
    sector = scan.ranges[np.abs(angles) < np.radians(20)]
    return float(np.nan_to_num(sector, nan=0.0).min()) if sector.size else 0.0
