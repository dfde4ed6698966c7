"""Feet of somebody who walks wherever they like: one rests on the floor while the other swings. Pure.

Those who walk their rounds (`people`) slide theirs to and fro by a sine, which is enough to be walked around. Who is
tracked by the legs needs feet that rest: a tracker is made for them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from skytether.lab.trail import Pose

from .people import HIP

Point = tuple[float, float]

_RESTS = 0.6
"""Share of a stride for which a foot is on the floor: both are for a tenth of it, twice."""
_STEP, _STEP_PER_SPEED = 0.25, 0.4
"""Length of a step at no speed [m], and what each m/s adds [s]: 0.41 m at 0.4 m/s."""
_MIDDLE = (1 + _RESTS) / 2
"""Phase in which a foot that swings passes the other one."""
_STOPPED = 0.2
"""Who has not moved for so long puts the feet together, s."""
_FOOT_SPEED = 0.8
"""Of the foot that does so, m/s."""
_HOME = 0.02
"""A foot so near to its place under the hip stays, m."""


@dataclass(slots=True)
class _Foot:
    """Side (1: left), where it is, and where it was lifted [m] at which phase, if it swings."""

    side: float
    place: Point
    phase: float
    lifted: tuple[Point, float] | None = None


class Gait:
    """Two feet under a body that moves."""

    def __init__(self, pose: Pose) -> None:
        self._feet = tuple(_Foot(side, _under(pose, side, 0.0), 0.0) for side in (1.0, -1.0))
        self._still = math.inf
        self._walking = False

    @property
    def feet(self) -> tuple[Point, Point]:
        """Left and right [m]."""
        left, right = self._feet
        return left.place, right.place

    def step(self, pose: Pose, moved: float, dt: float) -> None:
        """The body has come to this pose, moved [m] forward in dt seconds."""
        if moved > 0:
            self._still = 0.0
            if not self._walking:
                self._begin(pose)
            self._stride(pose, moved, moved / dt)
            return
        self._still += dt
        if self._still > _STOPPED:
            self._walking = False
            self._close(pose, dt)

    def _begin(self, pose: Pose) -> None:
        """The foot that is further back swings first, by half a step: the other one rests beneath the body."""
        self._walking = True
        first = min(self._feet, key=lambda foot: _along(pose, foot.place))
        for foot in self._feet:
            foot.lifted = (foot.place, _MIDDLE) if foot is first else None
            foot.phase = _MIDDLE if foot is first else _MIDDLE - 0.5

    def _stride(self, pose: Pose, moved: float, speed: float) -> None:
        step = _STEP + _STEP_PER_SPEED * min(speed, 1.5)
        for foot in self._feet:
            foot.phase += moved / (2 * step)
            if foot.phase >= 1:
                foot.phase, foot.lifted = foot.phase - 1, None
            if foot.phase < _RESTS:
                continue
            if foot.lifted is None:
                foot.lifted = (foot.place, _RESTS)
            (x, y), begun = foot.lifted
            share = (foot.phase - begun) / (1 - begun)
            # It lands as far ahead as the body needs, to pass over it in the middle of the rest; and what the body
            # itself goes until then is added, so that it swings to where it lands.
            ahead = _RESTS * step + (1 - foot.phase) * 2 * step
            to_x, to_y = _under(pose, foot.side, ahead)
            smooth = share * share * (3 - 2 * share)
            foot.place = (x + (to_x - x) * smooth, y + (to_y - y) * smooth)

    def _close(self, pose: Pose, dt: float) -> None:
        """One foot after the other to its place; the one in the air first."""
        for foot in sorted(self._feet, key=lambda foot: foot.lifted is None):
            goal = _under(pose, foot.side, 0.0)
            away = math.dist(foot.place, goal)
            if away <= _HOME and foot.lifted is None:
                continue
            foot.lifted = foot.lifted or (foot.place, _RESTS)
            share = min(1.0, _FOOT_SPEED * dt / away) if away > 0 else 1.0
            (x, y), (to_x, to_y) = foot.place, goal
            foot.place = (x + (to_x - x) * share, y + (to_y - y) * share)
            if share == 1.0:
                foot.lifted = None
            return


def _under(pose: Pose, side: float, ahead: float) -> Point:
    cos, sin = math.cos(pose.heading), math.sin(pose.heading)
    return pose.x + ahead * cos - side * HIP * sin, pose.y + ahead * sin + side * HIP * cos


def _along(pose: Pose, place: Point) -> float:
    return (place[0] - pose.x) * math.cos(pose.heading) + (place[1] - pose.y) * math.sin(pose.heading)
