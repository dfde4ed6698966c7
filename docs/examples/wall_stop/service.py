"""Drives straight on and stops before the wall."""

from dataclasses import dataclass

import numpy as np

from skytether.messages import LaserScan, Twist, Vector3
from skytether.service import Input, Output, Service, param


@dataclass(frozen=True)
class Params:
    """What a robot may set when it asks for the service."""

    distance: float = param(0.5, unit="m", gt=0, doc="room to leave before the wall")
    speed: float = param(0.2, unit="m/s", gt=0, le=1, doc="speed while the way is free")


class WallStop(Service[Params]):
    """One velocity for each laser scan."""

    trigger = "scan"

    scan = Input(LaserScan)
    cmd_vel = Output(Twist)

    def step(self, now: float) -> None:
        scan = self.scan.take()
        if scan and scan.age(now) < 0.5:
            room = ahead(scan.message) - self.params.distance
            self.cmd_vel.publish(Twist(Vector3(x=min(max(room, 0.0), self.params.speed))))


def ahead(scan: LaserScan) -> float:
    """Metres to the nearest thing within 20 degrees of straight on; 0 where the laser does not know."""
    angles = scan.angle_min + scan.angle_increment * np.arange(scan.ranges.size)
    sector = scan.ranges[np.abs(angles) < np.radians(20)]
    return float(np.nan_to_num(sector, nan=0.0).min()) if sector.size else 0.0
