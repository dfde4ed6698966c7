"""Geometry of a trail: straight lines and arcs, by arc length. No control in here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple


class Pose(NamedTuple):
    """Pose in the plane, odometry frame: [m], [m], [rad] from the x axis, positive to the left."""

    x: float
    y: float
    heading: float


ORIGIN = Pose(0.0, 0.0, 0.0)


_ROUND = math.tau * (1 + 1e-9)
"""Largest turn of one arc [rad]: a full circle, and what rounding of its radius adds."""


def wrap(angle: float) -> float:
    """The same angle in [-pi, pi)."""
    return (angle + math.pi) % math.tau - math.pi


def advance(pose: Pose, distance: float, turn: float) -> Pose:
    """The pose after an arc of constant curvature.

    Args:
        pose: Where the arc starts.
        distance: Length of the arc [m].
        turn: Change of heading over it [rad].
    """
    # Chord of the arc: distance * sin(turn / 2) / (turn / 2), at the mean heading. Exact, and finite for turn = 0.
    half = turn / 2
    chord = distance * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
    return Pose(
        pose.x + chord * math.cos(pose.heading + half),
        pose.y + chord * math.sin(pose.heading + half),
        wrap(pose.heading + turn),
    )


@dataclass(frozen=True, slots=True)
class Piece:
    """A straight line (curvature 0) or an arc, from its start pose.

    Attributes:
        start: Pose at its beginning.
        begin: Arc length of the trail at its beginning [m].
        length: Its own length [m].
        curvature: [1/m], positive to the left.
    """

    start: Pose
    begin: float
    length: float
    curvature: float

    def at(self, along: float) -> Pose:
        """Pose at ``along`` metres from its start."""
        return advance(self.start, along, along * self.curvature)

    def project(self, x: float, y: float) -> float:
        """Metres from its start to the foot of (x, y) on the endless line or the full circle, the nearest way round."""
        cos, sin = math.cos(self.start.heading), math.sin(self.start.heading)
        ahead = cos * (x - self.start.x) + sin * (y - self.start.y)
        left = -sin * (x - self.start.x) + cos * (y - self.start.y)
        if self.curvature == 0:
            return ahead
        # On the circle after turning by phi: ahead = sin(phi) / curvature, left = (1 - cos(phi)) / curvature. The cut
        # of the circle lies opposite the arc's middle, so that feet just before the start come out negative.
        phi = math.atan2(ahead * self.curvature, 1 - left * self.curvature)
        middle = self.length * self.curvature / 2
        return (middle + wrap(phi - middle)) / self.curvature


class Path:
    """A trail: pieces one after the other without a kink, from a start pose."""

    def __init__(self, pieces: Sequence[tuple[float, float]], start: Pose = ORIGIN) -> None:
        """From pairs (length [m], curvature [1/m], positive to the left).

        Raises:
            ValueError: There is no piece, a length is not above 0, or an arc is more than a full circle.
        """
        if not pieces:
            raise ValueError("trail: it needs at least one segment")
        self._pieces: list[Piece] = []
        self.length = 0.0
        """Arc length of the whole [m]."""
        for number, (length, curvature) in enumerate(pieces, 1):
            if not 0 < length < math.inf:
                raise ValueError(f"trail: segment {number} must be longer than 0 m, not {length}")
            if abs(length * curvature) > _ROUND:
                raise ValueError(f"trail: segment {number} is more than a full circle")
            self._pieces.append(Piece(start, self.length, length, curvature))
            start = self._pieces[-1].at(length)
            self.length += length

    def at(self, s: float) -> Pose:
        """Point and tangent at arc length s; outside the trail, on the straight continuation of its ends."""
        if s < 0:
            return advance(self._pieces[0].start, s, 0.0)
        for piece in self._pieces:
            if s < piece.begin + piece.length:
                return piece.at(s - piece.begin)
        last = self._pieces[-1]
        return advance(last.at(last.length), s - self.length, 0.0)

    def closest(self, x: float, y: float, low: float = 0.0, high: float = math.inf) -> float:
        """Arc length of the point nearest to (x, y) among those from ``low`` to ``high``.

        The window makes progress monotone, and keeps a trail that comes near itself from being cut short.
        """
        low, high = max(low, 0.0), min(high, self.length)
        best, best_distance = low, math.inf
        for piece in self._pieces:
            first, last = max(low - piece.begin, 0.0), min(high - piece.begin, piece.length)
            if first > last:
                continue
            foot = min(max(piece.project(x, y), first), last)
            point = piece.at(foot)
            distance = math.hypot(x - point.x, y - point.y)
            if distance < best_distance:
                best, best_distance = piece.begin + foot, distance
        return best
