"""Scans of people who walk about a laser: circles for legs, lines for walls. Independent of what finds them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

STEP = math.radians(0.35)
FIRST = -math.radians(135)
RAYS = 772
LIMITS = (0.03, 11.0)
LEG = 0.055
"""Radius of a leg, m."""

Place = tuple[float, float]


def feet(place: Place, heading: float, way: float) -> list[Place]:
    """Both feet of one who stands here [m], looks there [rad] and has walked so far [m]: 0.5 m a step."""
    swing = 0.25 * math.sin(math.pi * way / 0.5)
    cos, sin = math.cos(heading), math.sin(heading)
    return [
        (place[0] + cos * side * swing - sin * side * 0.12, place[1] + sin * side * swing + cos * side * 0.12)
        for side in (1.0, -1.0)
    ]


def scan(
    legs: Iterable[Place],
    walls: Sequence[tuple[Place, Place]] = (),
    laser: tuple[float, float, float] = (0.0, 0.0, 0.0),
    random: np.random.Generator | None = None,
    radius: float = LEG,
    step: float = STEP,
) -> np.ndarray:
    """Ranges of one scan [m], infinite where a ray meets nothing; noise of 5 mm if there is a generator."""
    x, y, heading = laser
    angles = heading + FIRST + step * np.arange(round(RAYS * STEP / step))
    cos, sin = np.cos(angles), np.sin(angles)
    ranges = np.full(len(angles), np.inf)
    for leg_x, leg_y in legs:
        along = (leg_x - x) * cos + (leg_y - y) * sin
        across = (leg_x - x) * sin - (leg_y - y) * cos
        hits = (along > 0) & (np.abs(across) < radius)
        ranges[hits] = np.minimum(ranges[hits], along[hits] - np.sqrt(radius**2 - across[hits] ** 2))
    for (ax, ay), (bx, by) in walls:
        # The ray p + t d meets the wall a + u (b - a): two equations for t and u.
        ex, ey = bx - ax, by - ay
        below = cos * ey - sin * ex
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((ax - x) * ey - (ay - y) * ex) / below
            u = ((ax - x) * sin - (ay - y) * cos) / below
        hits = (t > 0) & (u >= 0) & (u <= 1)
        ranges[hits] = np.minimum(ranges[hits], t[hits])
    if random is not None:
        ranges = ranges + 0.005 * random.standard_normal(len(angles))
    return np.where(ranges <= LIMITS[1], ranges, np.inf).astype(np.float32)
