"""Where the robot gets to on a curve, and all that an outline covers on the way. Pure geometry.

What is swept is kept as convex pieces that overlap. Each corner goes on an arc, which lies in the triangle of its ends
and the point where their tangents meet; so the hull of all these triangles is never too small.
"""

from __future__ import annotations

from math import ceil, cos, hypot, sqrt, tau

import numpy as np

from skytether.control.admittance import STANDSTILL, Velocity

from .footprint import Footprint, Points, is_straight, polygon

_TOO_MUCH_M = 0.02
"""What a piece may cover that the outline does not."""
_MOST_PIECES = 24
"""Two radians of a robot with sides of a metre are as exact as that; of longer turns the pieces are larger."""
_SHORTEST = 1e-6
"""Share of a line that is left; less is rounding."""


def moved(points: Points, velocity: Velocity, time: float) -> Points:
    """Where points of the robot are after a time [s] on the same curve, in the base frame of now."""
    turn = velocity.angular * time
    # The chord of the curve.
    half = turn / 2
    chord = velocity.linear * time * float(np.sin(half) / half if half else 1.0)
    c, s = np.cos(turn), np.sin(turn)
    x = c * points[:, 0] - s * points[:, 1] + chord * np.cos(half)
    y = s * points[:, 0] + c * points[:, 1] + chord * np.sin(half)
    return np.column_stack((x, y))


def swept(outline: Footprint, velocity: Velocity, time: float) -> tuple[Footprint, ...]:
    """Convex pieces that together are all that an outline covers within a time [s] on a curve, and hardly more."""
    if time <= 0 or velocity == STANDSTILL:
        return (outline,)
    corners = outline.vertices
    if is_straight(*velocity):
        return (_hull(corners, moved(corners, Velocity(velocity.linear, 0.0), time)),)
    turn = min(abs(velocity.angular) * time, tau)
    centre = (0.0, velocity.linear / velocity.angular)
    far = max(hypot(x - centre[0], y - centre[1]) for x, y in corners)
    longest = max(hypot(x, y) for x, y in np.roll(corners, -1, axis=0) - corners)
    # The tangents of an arc of the angle t and radius r meet r t^2 / 8 outside of it. Where a side of the length l
    # turns about its middle, its two ends go out and leave a notch of l t / 4 between them, which the hull fills.
    finest = max(sqrt(far / (8 * _TOO_MUCH_M)), longest / (4 * _TOO_MUCH_M))
    count = min(max(1, ceil(turn * finest)), _MOST_PIECES)
    step = turn / count / abs(velocity.angular)
    tangent = 1 / cos(turn / count / 2)
    pieces = []
    for piece in range(count):
        first, middle, last = (moved(corners, velocity, (piece + part) * step) for part in (0.0, 0.5, 1.0))
        pieces.append(_hull(first, centre + (middle - centre) * tangent, last))
    return tuple(pieces)


def boundary(pieces: tuple[Footprint, ...]) -> Points:
    """The outline of all pieces together: lines, each two points after each other, shape (2 n, 2) [m]."""
    starts = np.concatenate([piece.vertices for piece in pieces])
    along = np.concatenate([np.roll(piece.vertices, -1, axis=0) for piece in pieces]) - starts
    shares = np.array([piece.inner_shares(starts, along) for piece in pieces])
    enter, leave = np.where(shares[:, :1] < shares[:, 1:], shares, 0.0).transpose(1, 0, 2)
    order = enter.argsort(axis=0)
    ends = np.take_along_axis(leave, order, axis=0)
    # What is left of a line is from where all pieces before end to where the next begins.
    lines, ones = starts.shape[0], np.ones((1, starts.shape[0]))
    first = np.maximum.accumulate(np.concatenate((np.zeros((1, lines)), ends)), axis=0)
    last = np.concatenate((np.take_along_axis(enter, order, axis=0), ones))
    row, line = np.nonzero(last - first > _SHORTEST)
    both = np.stack((first[row, line], last[row, line]), axis=1)
    found: Points = (starts[line, None] + both[:, :, None] * along[line, None]).reshape(-1, 2)
    return found


def _hull(*corners: Points) -> Footprint:
    return polygon((x, y) for x, y in np.concatenate(corners).tolist())
