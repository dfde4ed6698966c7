"""From one message of a range sensor to points around the robot, or to the admission that it does not see. Pure.

Readings follow REP 117: from ``range_min`` to ``range_max`` there is something, from ``range_max`` on or +inf there is
nothing, below ``range_min`` or -inf there is something too close to be measured, NaN is no reading. A zero is no
reading either: drivers write it for "no echo" and for errors alike. Nobody knows what is behind a reading that is none.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from math import cos, degrees, isfinite, pi, radians, sin, tau

import numpy as np
from numpy.typing import NDArray

from skytether.messages import LaserScan, Message, Range

from .footprint import Points

MAX_RAYS = 20_000
"""Of one scan; more would cost the loop its time."""
_CONE_POINTS = 9
"""Across the cone of a sonar, which says how far but not where."""
_NO_POINTS: Points = np.empty((0, 2))


class Sight(StrEnum):
    """What a sensor knows."""

    CLEAR = "clear"
    """It sees what there is."""
    EMPTY = "empty"
    """It reports nothing within reach, in no direction: a wide hall, or a cover on the lens."""
    BLIND = "blind"
    """Too many readings beside each other are none."""
    NONSENSE = "nonsense"
    """Its message makes no sense: no rays, angles that are no numbers, limits the wrong way round."""
    STALE = "stale"
    """Its last message is too old, or none has come."""


UNKNOWN = frozenset({Sight.BLIND, Sight.NONSENSE, Sight.STALE})
"""Whatever may stand there is not seen."""


@dataclass(frozen=True, slots=True)
class Mount:
    """Where a range sensor is and how far it is to be believed.

    Attributes:
        x: Position in the base frame, forward [m].
        y: Position in the base frame, left [m].
        yaw: Direction of its x axis in the base frame [rad].
        upside_down: Mounted head over: its angles count to the right.
        range_min: Nearest it measures [m]; 0: as its messages say.
        range_max: Farthest it is to be believed [m]; 0: as its messages say.
        ignore: Sectors (from, to) in its own angles [rad] in which it sees the robot itself.
        max_gap: Widest sector without a reading that counts as seen through [rad].
        no_echo_is_free: NaN and zero mean that nothing is there, for lasers outdoors; never if all readings are such.
    """

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    upside_down: bool = False
    range_min: float = 0.0
    range_max: float = 0.0
    ignore: tuple[tuple[float, float], ...] = ()
    max_gap: float = radians(5)
    no_echo_is_free: bool = False


@dataclass(frozen=True, eq=False)
class View:
    """What one message says.

    Attributes:
        sight: How much it knows.
        points: What is seen, base frame, shape (n, 2) [m].
        detail: What a person should know about a poor sight.
    """

    sight: Sight
    points: Points
    detail: str = ""


def view(mount: Mount, message: Message) -> View:
    """What a message of a range sensor says. Never raises."""
    if isinstance(message, LaserScan):
        return _of_scan(mount, message)
    if isinstance(message, Range):
        return _of_cone(mount, message)
    return _nonsense(f"a {message.TYPE} is no message of a range sensor")


def _of_scan(mount: Mount, scan: LaserScan) -> View:
    ranges = np.asarray(scan.ranges, dtype=np.float64)
    near, far = mount.range_min or scan.range_min, mount.range_max or scan.range_max
    if not 0 < ranges.size <= MAX_RAYS:
        return _nonsense(f"{ranges.size} rays")
    if not (isfinite(scan.angle_min) and isfinite(scan.angle_increment) and scan.angle_increment != 0):
        return _nonsense(f"angle_min {scan.angle_min}, angle_increment {scan.angle_increment}")
    if abs(scan.angle_increment) * (ranges.size - 1) > tau + 0.1 or not abs(scan.angle_min) <= 2 * tau:
        return _nonsense(f"{ranges.size} rays, {degrees(scan.angle_increment):.3f} degrees apart, are more than a turn")
    if not 0 <= near < far:
        return _nonsense(f"range_min {near}, range_max {far}")
    angles = scan.angle_min + scan.angle_increment * np.arange(ranges.size, dtype=np.float64)
    used = np.ones(ranges.size, dtype=bool)
    for first, last in mount.ignore:
        used &= ~((angles >= first) & (angles <= last))
    return _judge(mount, ranges[used], angles[used], far, abs(scan.angle_increment))


def _judge(mount: Mount, ranges: NDArray[np.float64], angles: NDArray[np.float64], far: float, step: float) -> View:
    none = np.isnan(ranges) | (ranges == 0)
    if not ranges.size or none.all():
        return View(Sight.BLIND, _NO_POINTS, "no reading at all (only zeros and NaN)")
    seen = ~none & (ranges < far)
    gap = 0.0 if mount.no_echo_is_free else _longest(none) * step
    points = _place(mount, np.clip(ranges[seen], 0.0, None), angles[seen])
    if gap > mount.max_gap:
        return View(Sight.BLIND, points, f"no reading over {degrees(gap):.0f} degrees")
    if not seen.any():
        return View(Sight.EMPTY, points, f"nothing nearer than {far:g} m anywhere")
    return View(Sight.CLEAR, points)


def _of_cone(mount: Mount, message: Range) -> View:
    near, far = mount.range_min or message.min_range, mount.range_max or message.max_range
    width = message.field_of_view
    if not (0 <= near < far and 0 <= width <= pi):
        return _nonsense(f"min_range {near}, max_range {far}, field_of_view {width}")
    angles = np.linspace(-width / 2, width / 2, _CONE_POINTS, dtype=np.float64)
    found = _judge(mount, np.full(_CONE_POINTS, float(message.range)), angles, far, 0.0)
    # One reading of a sonar without an echo is its ordinary answer, where for a laser it is a cover on the lens.
    return View(Sight.CLEAR, found.points) if found.sight is Sight.EMPTY else found


def _longest(flags: NDArray[np.bool_]) -> int:
    """Length of the longest run."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False]))))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def _place(mount: Mount, ranges: NDArray[np.float64], angles: NDArray[np.float64]) -> Points:
    sense = -1.0 if mount.upside_down else 1.0
    along, across = ranges * np.cos(angles), sense * ranges * np.sin(angles)
    c, s = cos(mount.yaw), sin(mount.yaw)
    return np.column_stack((mount.x + c * along - s * across, mount.y + s * along + c * across))


def _nonsense(detail: str) -> View:
    return View(Sight.NONSENSE, _NO_POINTS, detail)
