"""From one message of a laser or a sonar to points around the robot, or to the admission that it does not see. Pure.

Readings follow REP 117: from ``range_min`` to ``range_max`` there is something, from ``range_max`` on or +inf there is
nothing, below ``range_min`` or -inf there is something too close to be measured, NaN is no reading. A zero is no
reading either: drivers write it for "no echo" and for errors alike. Nobody knows what is behind a reading that is none.
Where ``min_range`` equals ``max_range``, -inf says that there is something within that distance, +inf that there is
nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from functools import lru_cache
from math import cos, degrees, isfinite, isnan, pi, radians, sin, tau

import numpy as np
from numpy.typing import NDArray

from skytether.messages import LaserScan, Message, Range

from ..geometry.footprint import Footprint, Points
from .coverage import CELLS, Cells, between, no_cells, sector, widest

MAX_RAYS = 20_000
"""Of one scan; more would cost the loop its time."""
_KNOWN_RAYS = 8
"""Kinds of scans whose rays are remembered; one for each laser is enough."""
_CONE_POINTS = 9
"""Across the cone of a sonar, which says how far but not where."""
_ENDS_RAYS = 2.0
"""By so many rays ``angle_max`` may be off: drivers disagree whether it is the last ray's angle or the next one's."""
_ROUNDING = 1e-4
"""Of angles in float32 that are added up [rad]."""
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
    """Its message makes no sense: too few rays, angles that are no numbers, limits the wrong way round."""
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
        ignore: Sectors (from, counter-clockwise to) in its own angles [rad] in which it sees the robot itself.
        fov: Sector (from, counter-clockwise to) in its own angles [rad] that it must look into; None: as wide as the
            widest message so far.
        max_gap: Widest sector without a reading that counts as seen through [rad].
        max_step: From one ray to the next at most [rad].
        min_rays: Of a scan.
        no_echo_is_free: NaN and zero mean that nothing is there, for lasers outdoors; never if all readings are such.
    """

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    upside_down: bool = False
    range_min: float = 0.0
    range_max: float = 0.0
    ignore: tuple[tuple[float, float], ...] = ()
    fov: tuple[float, float] | None = None
    max_gap: float = radians(5)
    max_step: float = radians(2)
    min_rays: int = 10
    no_echo_is_free: bool = False

    @property
    def sense(self) -> float:
        """-1 if its angles count to the right in the base frame, else 1."""
        return -1.0 if self.upside_down else 1.0


@dataclass(frozen=True, eq=False)
class View:
    """What one message says.

    Attributes:
        sight: How much it knows.
        points: What is seen, base frame, shape (n, 2) [m].
        detail: What a person should know about a poor sight.
        edge: Ends of the rays that saw nothing within reach, base frame, shape (n, 2) [m]: the edge of what is known.
        looks: Cells of its own angles that were looked into, past all that is too close.
        spans: Cells that the message says it is about, looked into or not.
        near: Of each cell, what is nearer than this is not seen [m].
    """

    sight: Sight
    points: Points
    detail: str = ""
    edge: Points = field(default_factory=lambda: _NO_POINTS)
    looks: Cells = field(default_factory=no_cells)
    spans: Cells = field(default_factory=no_cells)
    near: NDArray[np.float64] = field(default_factory=lambda: np.zeros(CELLS))


def view(mount: Mount, outline: Footprint, message: Message, before: Cells | None = None) -> View:
    """What a message of a range sensor says. Never raises.

    Args:
        mount: Where it is, and what may be asked of it.
        outline: Of the robot: what is too close to be measured may touch it.
        message: A LaserScan or a Range.
        before: What its messages have spanned so far; less than that is blindness, unless `Mount.fov` says what is.
    """
    if isinstance(message, LaserScan):
        return _of_scan(mount, outline, message, before)
    if isinstance(message, Range):
        return _of_cone(mount, outline, message, before)
    return nonsense(f"a {message.TYPE} is no message of a range sensor")


@dataclass(frozen=True, slots=True, eq=False)
class _Rays:
    """What a scan's rays say whatever they measure: the same for one scan after the other, so it is not made anew.

    Attributes:
        used: Which of them count, in the order of rising angles.
        angles: Of those [rad].
        spans: Cells that all of them are about.
        looks: Cells that those that count look into.
        ignored: Cells that do not count.
        fov: Cells that `Mount.fov` asks for; None: it does not say.
    """

    used: NDArray[np.bool_]
    angles: NDArray[np.float64]
    spans: Cells
    looks: Cells
    ignored: Cells
    fov: Cells | None


@lru_cache(maxsize=_KNOWN_RAYS)
def _rays(mount: Mount, first: float, increment: float, count: int) -> _Rays:
    angles = first + increment * np.arange(count, dtype=np.float64)
    if increment < 0:
        angles = angles[::-1]
    used, ignored = np.ones(count, dtype=bool), no_cells()
    for start, end in mount.ignore:
        used &= ~_within(angles, start, end)
        ignored |= sector(start, end, touched=True)
    spans, looks = (between(these, abs(increment), mount.max_gap) for these in (angles, angles[used]))
    fov = None if mount.fov is None else sector(*mount.fov)
    rays = _Rays(used, angles[used], spans, looks, ignored, fov)
    for array in (rays.used, rays.angles, spans, looks, ignored):
        array.flags.writeable = False
    return rays


def _of_scan(mount: Mount, outline: Footprint, scan: LaserScan, before: Cells | None) -> View:
    ranges = np.asarray(scan.ranges, dtype=np.float64)
    near, far = mount.range_min or scan.range_min, mount.range_max or scan.range_max
    wrong = _wrong_angles(mount, scan, ranges.size)
    if wrong or not 0 <= near < far:
        return nonsense(wrong or f"range_min {near}, range_max {far}")
    rays = _rays(mount, scan.angle_min, scan.angle_increment, ranges.size)
    angles, spans = rays.angles, rays.spans
    ranges = (ranges[::-1] if scan.angle_increment < 0 else ranges)[rays.used]
    none, close = _no_reading(ranges), ranges < near
    close &= ~none
    answered = ~none | mount.no_echo_is_free
    if (none | close).all():
        said = "everything is too close to be measured" if close.any() else "no reading at all (only zeros and NaN)"
        return View(Sight.BLIND, too_close(mount, outline, angles[close], near), said, spans=spans)
    seen = ~none & ~close & (ranges < far)
    points = np.concatenate((place(mount, ranges[seen], angles[seen]), too_close(mount, outline, angles[close], near)))
    free = answered & ~close & ~seen
    edge = place(mount, np.full(int(free.sum()), far), angles[free])
    looks = _looks(mount, scan, rays, answered & ~close)
    heard = _looks(mount, scan, rays, answered) if close.any() else looks
    required = _required(spans, before) if rays.fov is None else rays.fov
    gap = widest(required & ~rays.ignored & ~heard)
    if gap > mount.max_gap:
        return View(Sight.BLIND, points, f"no reading over {degrees(gap):.0f} degrees", edge, looks, spans)
    if not seen.any() and not close.any():
        return View(Sight.EMPTY, points, f"nothing nearer than {far:g} m anywhere", edge, looks, spans)
    return View(Sight.CLEAR, points, "", edge, looks, spans)


def _looks(mount: Mount, scan: LaserScan, rays: _Rays, which: NDArray[np.bool_]) -> Cells:
    """Cells that some of a scan's rays look into."""
    return rays.looks if which.all() else between(rays.angles[which], abs(scan.angle_increment), mount.max_gap)


def _wrong_angles(mount: Mount, scan: LaserScan, rays: int) -> str:
    """What makes no sense about a scan's rays; empty: nothing."""
    step = scan.angle_increment
    if not mount.min_rays <= rays <= MAX_RAYS:
        return f"{rays} rays, where {mount.min_rays} (min_rays) to {MAX_RAYS} are expected"
    if not (isfinite(scan.angle_min) and isfinite(step) and step != 0):
        return f"angle_min {scan.angle_min}, angle_increment {step}"
    if abs(step) * (rays - 1) > tau + 0.1 or not abs(scan.angle_min) <= 2 * tau:
        return f"{rays} rays, {degrees(step):.3f} degrees apart, are more than a turn"
    if abs(step) > mount.max_step * 1.001:
        return f"its rays are {degrees(step):.1f} degrees apart, {degrees(mount.max_step):.1f} at most (max_step_deg)"
    last = scan.angle_min + step * (rays - 1)
    # Zero is what a driver leaves that does not say it.
    if scan.angle_max != 0 and not abs(scan.angle_max - last) <= max(_ENDS_RAYS * abs(step), mount.max_step):
        return f"angle_max {scan.angle_max:.3f} is not where its {rays} rays end: {last:.3f}"
    return ""


def _of_cone(mount: Mount, outline: Footprint, message: Range, before: Cells | None) -> View:
    near, far = mount.range_min or message.min_range, mount.range_max or message.max_range
    width, value = message.field_of_view, message.range
    if not (0 <= near <= far and isfinite(far) and far > 0 and 0 <= width <= pi):
        return nonsense(f"min_range {near}, max_range {far}, field_of_view {width}")
    angles = np.linspace(-width / 2, width / 2, _CONE_POINTS, dtype=np.float64)
    spans = sector(-width / 2, width / 2)
    if isnan(value) or value == 0:
        return View(Sight.BLIND, _NO_POINTS, "no reading at all (only zeros and NaN)", spans=spans)
    points, edge, looks = _NO_POINTS, _NO_POINTS, spans
    if value < near or value <= near == far:
        points, looks = too_close(mount, outline, angles, near), no_cells()
    elif value < far:
        points = place(mount, np.full(_CONE_POINTS, value), angles)
    else:
        edge = place(mount, np.full(_CONE_POINTS, far), angles)
    missing = (_required(spans, before) if mount.fov is None else sector(*mount.fov)) & ~spans
    gap = widest(missing)
    if gap > mount.max_gap:
        said = f"its cone is {degrees(width):.0f} degrees wide, and {degrees(gap):.0f} degrees beside it are missing"
        return View(Sight.BLIND, points, said, edge, looks, spans)
    # Nothing in reach is a sonar's ordinary answer, where for a laser it may be a cover on the lens.
    return View(Sight.CLEAR, points, "", edge, looks, spans)


def _required(spans: Cells, before: Cells | None) -> Cells:
    """What the sensor must look into, where nobody configured it."""
    return spans if before is None else spans | before


def _no_reading(ranges: NDArray[np.float64]) -> NDArray[np.bool_]:
    none: NDArray[np.bool_] = np.isnan(ranges) | (ranges == 0)
    return none


def _within(angles: NDArray[np.float64], first: float, last: float) -> NDArray[np.bool_]:
    """Which angles are in a sector, whole turns more or less."""
    width = last - first if last >= first else (last - first) % tau
    found: NDArray[np.bool_] = (angles - first + _ROUNDING) % tau <= width + 2 * _ROUNDING
    return found


def too_close(mount: Mount, outline: Footprint, angles: NDArray[np.float64], near: float) -> Points:
    """What is nearer than can be measured may be anywhere up to there: at the robot's outline at the nearest."""
    if not len(angles):
        return _NO_POINTS
    ways = outline.ways_out((mount.x, mount.y), _bearings(mount, angles))
    return np.concatenate((place(mount, ways, angles), place(mount, np.maximum(ways, near), angles)))


def _bearings(mount: Mount, angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Own angles as directions in the base frame."""
    return mount.yaw + mount.sense * angles


def place(mount: Mount, ranges: NDArray[np.float64], angles: NDArray[np.float64]) -> Points:
    """Points by their distance and own angle, in the base frame."""
    along, across = ranges * np.cos(angles), mount.sense * ranges * np.sin(angles)
    c, s = cos(mount.yaw), sin(mount.yaw)
    return np.column_stack((mount.x + c * along - s * across, mount.y + s * along + c * across))


def nonsense(detail: str) -> View:
    """Nothing can be taken from a message."""
    return View(Sight.NONSENSE, _NO_POINTS, detail)
