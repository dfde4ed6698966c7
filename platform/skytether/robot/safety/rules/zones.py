"""Slow and stop zones in the direction of motion: what share of a velocity the robot may have. Pure.

The stop zone is the footprint with room around. A velocity is allowed as far as the robot, going on along the same
curve, would come to a standstill before anything that is seen gets into that zone (`stopping` has the inequality):
with c the time until contact at this velocity, r the reaction time of all stages and d the slow-down that braking
allows, the share s solves ``s r + s^2 / (2 d) = c``. Within the slow zone, that many metres of way before the stop
zone, the speed has a limit as well.

The way is that of the outermost corner, so that the same metres hold for turning on the spot.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from math import inf, isinf
from typing import ClassVar

import numpy as np
from pydantic import ConfigDict

from skytether.control.admittance import Velocity
from skytether.control.numbers import check_positive
from skytether.robot.control.supervisor import VelocityLimits

from ..geometry import kinematics
from ..geometry.dead_reckoning import Variation
from ..geometry.footprint import Footprint, Outlines, Points
from ..geometry.stopping import Stages, fastest

_TOUCH_M = 0.005
"""Way before the stop zone at which the robot stands, instead of creeping up to it for ever."""


class Zone(StrEnum):
    """What lies ahead."""

    CLEAR = "clear"
    SLOW = "slow"
    STOP = "stop"
    UNKNOWN = "unknown"
    """Nothing is known to be in the way, but not all of it is seen. `Zones` itself never says so."""


@dataclass(frozen=True, slots=True)
class ZoneParams:
    """Sizes of the zones.

    Attributes:
        stop_m: Room around the footprint that nothing may get into [m].
        slow_m: Length of the slow zone before the stop zone, along the way [m].
        slow_speed: Of the outermost corner within the slow zone [m/s].
        hysteresis_m: More way than this must be free, or be free beyond the slow zone, before a zone is left [m].
        sensing_s: From the light of a sensor to its message at the gate; a rotating laser's turn belongs to it [s].
        reaction_s: From a velocity that is written to its first effect at the wheels [s].
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid", allow_inf_nan=False)

    stop_m: float = 0.1
    slow_m: float = 0.5
    slow_speed: float = 0.1
    hysteresis_m: float = 0.05
    sensing_s: float = 0.05
    reaction_s: float = 0.1

    def __post_init__(self) -> None:
        """Refuse zones that would not stop.

        Raises:
            ValueError: A field is out of its range; the text names it.
        """
        check_positive(self, "zones", self.__slots__)


@dataclass(frozen=True, slots=True)
class Allowed:
    """What the zones say.

    Attributes:
        share: Of the velocity, 0 to 1.
        zone: What lies ahead.
        way: Of the outermost corner until something gets into the stop zone [m]; inf: nothing near.
    """

    share: float
    zone: Zone
    way: float


@dataclass(frozen=True, slots=True, eq=False)
class Asked:
    """What zones are asked, see `Zones.allow`.

    Attributes:
        velocity: What is wanted.
        points: What is seen.
        varied: How the velocity changed.
        before: What was said the time before.
    """

    velocity: Velocity
    points: Points
    varied: Variation
    before: Zone


class Zones:
    """The zones of one robot.

    Args:
        params: Sizes.
        footprint: Outline of the robot with all that it carries.
        limits: What the wheels may do; the braking among them is relied upon.
        stages: Latencies from the light to the brakes.
    """

    def __init__(self, params: ZoneParams, footprint: Footprint, limits: VelocityLimits, stages: Stages) -> None:
        self._outlines = Outlines(footprint, params.stop_m)
        self.stop = self._outlines.least
        self._params = params
        self._stages = stages
        self._limits = limits
        self._radius = footprint.radius

    def speed(self, velocity: Velocity) -> float:
        """Of the outermost corner, at most [m/s]."""
        return abs(velocity.linear) + abs(velocity.angular) * self._radius

    def slow(self, velocity: Velocity) -> float:
        """The share of a velocity that is not faster than the slow zone allows."""
        speed = self.speed(velocity)
        return min(1.0, self._params.slow_speed / speed) if speed else 1.0

    def stopping(self, velocity: Velocity) -> float:
        """How far the outermost corner gets until it stands, all stages at their worst [m]."""
        speed = self.speed(velocity)
        return speed * (self._stages.reaction_s(0.0) + 0.5 / kinematics.slowdown(self._limits, velocity))

    def way(self, velocity: Velocity) -> float:
        """Of the outermost corner until it stands, and the room that it must have then [m]."""
        return self.stopping(velocity) + self._params.stop_m

    def outline(self, velocity: Velocity, varied: Variation) -> Footprint:
        """The stop zone, with what is not known of where the robot is; see `allow`."""
        return self._outlines(self._unsure(velocity, varied))

    def counts(self, velocity: Velocity, before: Zone) -> float:
        """What is farther on the way than this does not make the robot slower [m]; see `allow`."""
        return max(self._slow_way(before), self._stop_way(before), self.stopping(velocity))

    def allow(self, velocity: Velocity, points: Points, varied: Variation, before: Zone) -> Allowed:
        """Say what share of a velocity is safe.

        Args:
            velocity: What is wanted.
            points: Everything that is seen, where it lies by now, shape (n, 2), base frame [m].
            varied: How the velocity changed since the oldest of them was seen, and a little before.
            before: What was said the time before.
        """
        speed = self.speed(velocity)
        if speed == 0:
            return Allowed(1.0, before, inf)
        slowdown = kinematics.slowdown(self._limits, velocity)
        contact = self._contact(velocity, points, varied)
        way = contact * speed
        zone = self._zone(way, before)
        if zone is Zone.STOP:
            return Allowed(0.0, zone, way)
        share = self._share(contact, slowdown)
        if zone is Zone.SLOW:
            share = min(share, self.slow(velocity))
        return Allowed(share, zone, way)

    def within_sight(self, velocity: Velocity, edge: Points, varied: Variation) -> float:
        """The share of a velocity from which the robot stands before it gets to where it has seen nothing yet.

        Args:
            velocity: What is wanted.
            edge: Where the sensors' sight ends, shape (n, 2), base frame [m].
            varied: As for `allow`.
        """
        if self.speed(velocity) == 0:
            return 1.0
        return self._share(self._contact(velocity, edge, varied), kinematics.slowdown(self._limits, velocity))

    def _contact(self, velocity: Velocity, points: Points, varied: Variation) -> float:
        """Time until the first of the points gets into the stop zone [s]; inf: none within all that could matter."""
        unsure = self._unsure(velocity, varied)
        near = points[np.hypot(points[:, 0], points[:, 1]) <= self._reach(velocity) + unsure]
        return self._outlines(unsure).time_to_contact(near, velocity.linear, velocity.angular)

    def _reach(self, velocity: Velocity) -> float:
        """Distance from the origin of what could matter [m]."""
        horizon = max(self._params.slow_m + self._params.hysteresis_m, self.stopping(velocity))
        return self.stop.radius + horizon

    def _unsure(self, velocity: Velocity, varied: Variation) -> float:
        """How far off things may be, as the wheels may be late [m]."""
        return self._stages.late_s * (varied.linear + varied.angular * self._reach(velocity))

    def _share(self, contact: float, slowdown: float) -> float:
        """Of the velocity that touches after this time, so that the robot stands before."""
        return 1.0 if isinf(contact) else min(1.0, fastest(contact, slowdown, self._stages.reaction_s(0.0)))

    def _zone(self, way: float, before: Zone) -> Zone:
        if way <= self._stop_way(before):
            return Zone.STOP
        return Zone.SLOW if way <= self._slow_way(before) else Zone.CLEAR

    def _stop_way(self, before: Zone) -> float:
        return _TOUCH_M + (self._params.hysteresis_m if before is Zone.STOP else 0.0)

    def _slow_way(self, before: Zone) -> float:
        return self._params.slow_m + (self._params.hysteresis_m if before is not Zone.CLEAR else 0.0)
