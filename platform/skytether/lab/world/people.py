"""People who walk their ways: where their legs and trunk are, step by step. Pure, and made without chance.

They are careful: who would come nearer than `CLEARANCE` to a robot with the next step stands and waits. So a contact
between robot and person is the robot's doing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from skytether.lab.trail import Pose

from .plan import Walk

CLEARANCE = 0.85
"""From the middle of a robot to a person who goes on walking, m: half a robot, a leg, and a stride of a foot."""

HIP = 0.11
"""Of each leg beside the middle, m."""
_STRIDE = 0.45
"""Way of one step, m; the legs swing by half of it."""
_TURNING = 3.0
"""rad/s."""
_SETTLE = 3.0
"""Rate at which the legs of one who stopped come together, 1/s."""


class Stance(NamedTuple):
    """Where parts of a person are [m]: left foot, right foot, trunk."""

    left: tuple[float, float]
    right: tuple[float, float]
    trunk: tuple[float, float]


class Person:
    """Walks a `Walk`. Stands at its first point until it begins."""

    def __init__(self, walk: Walk) -> None:
        self.walk = walk
        (x, y), (next_x, next_y) = walk.way[:2]
        self.pose = Pose(x, y, math.atan2(next_y - y, next_x - x))
        self.begun = walk.after is None
        self.done = False
        self._next = 1
        self._wait = 0.0
        self._phase = 0.0
        self._swing = 0.0

    def step(self, robots: Sequence[tuple[float, float]], dt: float) -> Stance:
        """Go on for dt seconds among robots whose middles are there [m]."""
        if not self.begun and self.walk.after is not None:
            x, y, near = self.walk.after
            self.begun = any(math.dist(robot, (x, y)) <= near for robot in robots)
        moved = 0.0
        if self.begun and not self.done:
            if self._wait > 0:
                self._wait -= dt
            else:
                moved = self._advance(robots, dt)
        if moved:
            self._phase += math.pi * moved / _STRIDE
            self._swing = min(1.0, self._swing + _SETTLE * dt)
        else:
            self._swing = max(0.0, self._swing - _SETTLE * dt)
        return self._stance()

    def _advance(self, robots: Sequence[tuple[float, float]], dt: float) -> float:
        """Turn to the next point or walk; returns the way walked [m]."""
        goal, (x, y, heading) = self.walk.way[self._next], self.pose
        away = math.dist((x, y), goal)
        turn = math.remainder(math.atan2(goal[1] - y, goal[0] - x) - heading, math.tau) if away > 0 else 0.0
        if abs(turn) > 1e-6:
            heading += min(max(turn, -_TURNING * dt), _TURNING * dt)
            if abs(turn) > 0.5:
                self.pose = Pose(x, y, heading)
                return 0.0
        way = min(self.walk.speed * dt, away)
        if way > 0:
            there = (x + (goal[0] - x) * way / away, y + (goal[1] - y) * way / away)
            if any(math.dist(robot, there) < min(CLEARANCE, math.dist(robot, (x, y))) for robot in robots):
                return 0.0
            x, y = there
        self.pose = Pose(x, y, heading)
        if away - way < 1e-9:
            self._arrive()
        return way

    def _arrive(self) -> None:
        self._next += 1
        self._wait = self.walk.pause
        if self._next == len(self.walk.way):
            # A round that does not end where it began is walked back.
            self._next = 0
            self.done = not self.walk.again

    def _stance(self) -> Stance:
        x, y, heading = self.pose
        cos, sin = math.cos(heading), math.sin(heading)
        swing = self._swing * _STRIDE / 2 * math.sin(self._phase)

        def foot(side: float) -> tuple[float, float]:
            along, across = side * swing, side * HIP
            return x + cos * along - sin * across, y + sin * along + cos * across

        return Stance(foot(1.0), foot(-1.0), (x, y))
