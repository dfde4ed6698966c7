"""From one cloud of points to points around the robot, or to the admission that its sensor does not see. Pure.

**What stops the robot** is a point between two heights: what is lower is floor, what is higher the robot passes
under. Every point of the cloud is looked at, and none is left out: they become the corners of the cells of floor that
they stand on (`cloud_grid`).

**What is seen.** A depth camera says NaN for too far and too near alike, and nothing at all of what is black or shines.
So a direction counts as looked into only where rays that go down to the floor come back, from the floor or from what
stands on it: from the lowest that it has ever had there up to those that would meet the floor at ``range_max``, with
no hole as wide and as high as ``max_gap``. Of rays that go up nothing is asked: the sky answers none. What is so near
that the lowest rays pass above it is not seen either (`View.near`), and where no obstacle is, sight ends with the
farthest reading.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from math import atan, cos, degrees, pi, sin, tau

import numpy as np
from numpy.typing import NDArray

from skytether.messages import Message, PointCloud2

from ..geometry.footprint import Footprint, Points
from .cloud_fields import FARTHEST_M, Coordinates, Floats, Line, absurd, coordinates
from .cloud_grid import Grid
from .coverage import CELLS, Cells, between, no_cells, sector, widest
from .ranges import Mount, Sight, View, nonsense, place, too_close

_SAMPLE = 12_000
"""Points at most that tell where is looked; a wider grid of them finds fewer directions, never more."""
_DEEP_M, _DEEP_SLOPE = 0.3, 0.25
"""What is lower than the floor by that much, and by this share of its distance, is no floor."""
_MOST_COLUMNS = 0.9
"""Share of the columns with a reading from which on the others' angles are known well enough to be remembered."""
_BLOCK = 16_384
"""Points that are looked at together."""
_NO_SHARE = 1e-7
_CELL = tau / CELLS
_NO_POINTS: Points = np.empty((0, 2))


@dataclass(frozen=True, slots=True)
class CloudMount(Mount):
    """Where a sensor of clouds is, how it looks, and which heights count. Its own angles are those of `yaw`, level.

    Attributes:
        z: Height above the floor [m].
        pitch: How far it looks down [rad].
        roll: About the way it looks, positive: its left side is up [rad].
        optical: Its clouds have z forward, x to the right, y down; None: if their frame's name ends in ``_optical`` or
            ``_optical_frame``.
        min_z: What is lower is floor [m].
        max_z: What is higher does not stop the robot [m].
        slope: Rise of the floor with the distance from the sensor that still is floor.
        min_points: Readings of a cloud at least.
    """

    z: float = 0.5
    pitch: float = 0.0
    roll: float = 0.0
    optical: bool | None = None
    min_z: float = 0.05
    max_z: float = 1.0
    slope: float = 0.0
    min_points: int = 100

    @property
    def bin_cells(self) -> int:
        """Width and height of what must have a reading, in cells: a hole of `max_gap` has two whole ones each way."""
        return _widest_bin(self.max_gap)

    @property
    def bins(self) -> tuple[int, int]:
        """Shape of what its views span: rows from straight down to the rays that meet the floor at `range_max`.

        One more row has what its columns stand for.
        """
        steepest = atan(self.z / self.range_max)
        return int((pi / 2 - steepest) / (self.bin_cells * _CELL)) + 1, CELLS // self.bin_cells


def view_of_cloud(mount: CloudMount, outline: Footprint, message: Message, before: Cells | None = None) -> View:
    """What a cloud says. Never raises.

    Args:
        mount: Where its sensor is, and what may be asked of it.
        outline: Of the robot: what is too close to be measured may touch it.
        message: A PointCloud2.
        before: `View.spans` of its messages so far, all together.
    """
    if not isinstance(message, PointCloud2):
        return nonsense(f"a {message.TYPE} is no cloud of points")
    found = coordinates(message)
    if isinstance(found, str):
        return nonsense(found)
    if not found.x.size:
        return View(Sight.BLIND, _NO_POINTS, "an empty cloud", spans=np.zeros(mount.bins, dtype=bool))
    if found.x.shape[0] == 1 and mount.fov is None:
        return nonsense("a cloud of one row does not say where it looks: fov_deg is needed")
    axes = _axes(mount, message.header.frame_id)
    with np.errstate(all="ignore"):  # NaN and infinity are what is asked for below
        seen = _Seen(mount, axes, found)
        return _judge(mount, seen, _obstacles(mount, outline, axes, found), before)


def _axes(mount: CloudMount, frame: str) -> Floats:
    """Rows that turn a message's coordinates into ahead, left and up of a level sensor that looks along `yaw`."""
    cp, sp, cr, sr = cos(mount.pitch), sin(mount.pitch), cos(mount.roll), sin(mount.roll)
    turn = np.array([[cp, sp * sr, sp * cr], [0, cr, -sr], [-sp, cp * sr, cp * cr]])
    optical = frame.endswith(("_optical", "_optical_frame")) if mount.optical is None else mount.optical
    if optical:
        turn = turn @ np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    return turn.astype(np.float32)


def _along(row: Floats, x: Line, y: Line, z: Line) -> Floats:
    """One level coordinate; axes that have no part in it are left out, as nearly all mounts have such."""
    found: Floats | None = None
    for share, values in zip(row, (x, y, z), strict=True):
        if abs(share) > _NO_SHARE:
            more: Floats = np.multiply(values, share, dtype=np.float32, casting="same_kind")
            found = more if found is None else np.add(found, more, out=more)
    return np.zeros(len(x), dtype=np.float32) if found is None else found


def _squared(x: Floats, y: Floats, z: Floats) -> Floats:
    squared, more = x * x, y * y
    squared += more
    np.multiply(z, z, out=more)
    squared += more
    return squared


def _picked(at: NDArray[np.intp], *lines: Line) -> Iterator[Floats]:
    """Some points of a block; all of them are quicker taken together."""
    return ((line if len(at) == len(line) else line[at]).astype(np.float32, copy=False) for line in lines)


def _obstacles(mount: CloudMount, outline: Footprint, axes: Floats, cloud: Coordinates) -> Points:
    """What stands between the heights, and what is too close to be measured; base frame. Of every point."""
    near, far = mount.range_min, mount.range_max
    low, high = np.float32(mount.min_z - mount.z), np.float32(mount.max_z - mount.z)
    floor, close = Grid(far), np.zeros(CELLS, dtype=bool)
    for line in cloud.blocks(_BLOCK):
        if near:
            squared = _squared(*(part.astype(np.float32) for part in line))
            at = np.flatnonzero((squared > 0) & (squared < near * near))
            if len(at):
                x, y, z = _picked(at, *line)
                close[_cells(np.arctan2(_along(axes[1], x, y, z), _along(axes[0], x, y, z)))] = True
        up = _along(axes[2], *line)
        at = np.flatnonzero((up >= low) & (up <= high))
        if len(at):
            x, y, z = _picked(at, *line)
            squared = _squared(x, y, z)
            ahead, left = _along(axes[0], x, y, z), _along(axes[1], x, y, z)
            if mount.slope or not (near * near <= squared.min() > 0 and squared.max() < far * far):
                used = (squared > 0) & (squared >= near * near) & (squared < far * far)
                if mount.slope:
                    used &= up.take(at) >= low + np.float32(mount.slope) * np.sqrt(ahead * ahead + left * left)
                ahead, left = ahead[used], left[used]
            floor.add(ahead, left)
    ahead_left = floor.corners()
    level, bearings = np.hypot(*ahead_left.T), np.arctan2(ahead_left[:, 1], ahead_left[:, 0])
    ignored = _ignored(mount)
    free = ~ignored[_cells(bearings)]
    angles = (np.flatnonzero(close & ~ignored).astype(np.float64) + 0.5) * _CELL
    points = place(mount, level[free], bearings[free])
    return np.concatenate((points, too_close(mount, outline, angles, near)))


class _Seen:
    """Where readings come from: bins of directions, in own level angles.

    Attributes:
        readings: How many the cloud has, about.
        absurd: Its numbers are bytes of something else.
        within: Whether any of them is within `range_max`.
        measured: Not all of them are too close to be measured.
        deep: Most of what is seen below lies deep below the floor.
        down: Bins with a reading of a ray that goes down to the floor, shape (rows from straight down, bins around).
        close: Bins around in which one is.
        reach: Of each bin around, how far away on the floor its farthest reading is [m].
        columns: Bins around that the columns of an organised cloud stand for.
        sure: Whether these are to be remembered.
    """

    def __init__(self, mount: CloudMount, axes: Floats, cloud: Coordinates) -> None:
        height, width = cloud.x.shape
        rows, columns = _strides(height, width)
        sample = cloud.sample(rows, columns)
        self.absurd = absurd(*sample)
        x, y, z = (line.astype(np.float32) for line in sample)
        shape = (-1, -(-width // columns))
        squared = _squared(x, y, z)
        used = (squared > 0) & (squared < FARTHEST_M**2)
        at = np.flatnonzero(used)
        x, y, z, squared = x.take(at), y.take(at), z.take(at), squared.take(at)
        ahead, left, up = (_along(row, x, y, z) for row in axes)
        level, around = np.sqrt(ahead * ahead + left * left), np.arctan2(left, ahead)
        self.readings = len(at) * cloud.x.size // used.size
        self.within = bool((squared < mount.range_max**2).any())
        near = squared < mount.range_min**2
        size, (more, turn) = mount.bin_cells * _CELL, mount.bins
        rises = ((np.arctan2(up, level) + np.float32(pi / 2)) * np.float32(1 / size)).astype(np.int32)
        bins = _cells(around) // mount.bin_cells
        self.close = np.zeros(turn, dtype=bool)
        self.close[bins[near]] = True
        self.measured = not near.all()
        self.reach = np.zeros(turn, dtype=np.float32)
        np.maximum.at(self.reach, bins, np.minimum(level, np.float32(mount.range_max)))
        below = np.flatnonzero((rises >= 0) & (rises < more - 1))
        self.down = np.zeros((more - 1, turn), dtype=bool)
        self.down[rises.take(below), bins.take(below)] = True
        deep = up.take(below) < -mount.z - _DEEP_M - _DEEP_SLOPE * level.take(below)
        self.deep = int(deep.sum()) * 2 > len(below)
        self.columns, self.sure = np.zeros(turn, dtype=bool), False
        if height > 1:
            angles = np.zeros(used.size, dtype=np.float32)
            angles[at] = around
            self.columns, self.sure = _columns(mount, angles.reshape(shape), used.reshape(shape))


def _judge(mount: CloudMount, seen: _Seen, points: Points, before: Cells | None) -> View:
    """Put together what is known."""
    if seen.absurd:
        return nonsense("its numbers are of no size that anything has: is_bigendian and the fields' offsets are wrong")
    mounted = "is it mounted as z, pitch_deg, roll_deg and optical say?"
    if seen.deep:
        return View(Sight.NONSENSE, points, f"most of what it sees lies deep below the floor; {mounted}")
    wrong = ""
    if not seen.readings:
        wrong = "no reading at all (only zeros and NaN)"
    elif seen.readings < mount.min_points:
        wrong = f"{seen.readings} readings, {mount.min_points} at least (min_points)"
    elif not seen.measured:
        wrong = "everything is too close to be measured"
    elif not seen.down.any():
        wrong = f"it sees nothing of the floor; {mounted}"
    if wrong:
        return View(Sight.BLIND, points, wrong, spans=np.zeros(mount.bins, dtype=bool))
    spans = np.vstack((seen.down, seen.columns if seen.sure else np.zeros_like(seen.columns)))
    known = spans if before is None else spans | before
    has = _without_holes(known[:-1], seen.down)
    asked = known[:-1].any(axis=0) | known[-1] | seen.columns
    cells, ignored = mount.bin_cells, _ignored(mount)
    filled = _filled(mount, has) & ~ignored
    looks = filled & ~np.repeat(seen.close, cells)
    required = np.repeat(asked, cells) if mount.fov is None else sector(*mount.fov)
    near = _near(mount, seen.down)
    edge = _edge(mount, seen, points, has, ignored)
    gap = widest(required & ~ignored & ~filled)
    if gap > mount.max_gap:
        return View(Sight.BLIND, points, f"no reading over {degrees(gap):.0f} degrees", edge, looks, spans, near)
    if not seen.within:
        return View(
            Sight.EMPTY, points, f"nothing nearer than {mount.range_max:g} m anywhere", edge, looks, spans, near
        )
    return View(Sight.CLEAR, points, "", edge, looks, spans, near)


def _strides(height: int, width: int) -> tuple[int, int]:
    """Every how many rows and columns are looked at for directions."""
    if height == 1:
        # Odd: the rings of a lidar come in turn, and there is an even number of them.
        return 1, -(-width // _SAMPLE) | 1
    rows = columns = 1
    while -(-height // rows) * -(-width // columns) > _SAMPLE:
        if width // columns >= height // rows:
            columns += 1
        else:
            rows += 1
    return rows, columns


def _columns(mount: CloudMount, around: Floats, used: NDArray[np.bool_]) -> tuple[Cells, bool]:
    """Bins between the outermost columns, those without a reading too: columns are about evenly far apart."""
    at = np.flatnonzero(used.any(axis=0))
    bins = np.zeros(CELLS // mount.bin_cells, dtype=bool)
    if not len(at):
        return bins, False
    angles = np.unwrap(around[used.argmax(axis=0)[at], at].astype(np.float64))
    step = (angles[-1] - angles[0]) / max(1, at[-1] - at[0])
    ends = (angles[0] - step * at[0], angles[-1] + step * (used.shape[1] - 1 - at[-1]))
    first, last = min(*ends, *angles[[0, -1]]), max(*ends, *angles[[0, -1]])
    whole = sector(first, min(last, first + tau)).reshape(-1, mount.bin_cells)
    bins[:] = whole.all(axis=1)
    return bins, len(at) >= _MOST_COLUMNS * used.shape[1]


def _without_holes(known: Cells, down: Cells) -> Cells:
    """Bins around that are looked into: with a reading, and without a hole where others were before or are beside."""
    asked = np.logical_or.accumulate(known) & np.logical_or.accumulate(known[::-1])[::-1]
    missing = asked & ~down
    hole = missing[:-1] & missing[1:]
    hole &= np.roll(hole, -1, axis=1)
    starts = hole.any(axis=0)
    found: Cells = down.any(axis=0) & ~starts & ~np.roll(starts, 1)
    return found


def _filled(mount: CloudMount, has: Cells) -> Cells:
    """Cells that are looked into; as with rays, up to `max_gap` beside each other need no reading of their own."""
    size = mount.bin_cells * _CELL
    starts = np.flatnonzero(has) * size
    return between(np.column_stack((starts, starts + size)).reshape(-1), size, mount.max_gap)


def _near(mount: CloudMount, down: Cells) -> NDArray[np.float64]:
    """Of each cell, what is nearer than this passes below the lowest ray: something as low as counts [m]."""
    size = mount.bin_cells * _CELL
    lowest = np.where(down.any(axis=0), down.argmax(axis=0), 0)
    steep = np.tan(pi / 2 - (lowest + 1) * size)
    near = np.where(down.any(axis=0), max(0.0, mount.z - mount.min_z) / steep, 0.0)
    wide = near
    for _ in range(int(mount.max_gap / size) + 1):  # of bins that count because those beside them do
        wide = np.maximum(wide, np.maximum(np.roll(wide, 1), np.roll(wide, -1)))
    return np.repeat(np.where(near > 0, near, wide), mount.bin_cells)


def _edge(mount: CloudMount, seen: _Seen, points: Points, has: Cells, ignored: Cells) -> Points:
    """Where sight ends: with the farthest reading of each bin around in which nothing stands."""
    size = mount.bin_cells * _CELL
    free = has & ~ignored.reshape(-1, mount.bin_cells).any(axis=1)
    bearings = np.arctan2(points[:, 1] - mount.y, points[:, 0] - mount.x) - mount.yaw
    free[_cells(bearings) // mount.bin_cells] = False
    at = np.flatnonzero(free)
    return place(mount, seen.reach[at].astype(np.float64), (at.astype(np.float64) + 0.5) * size)


@cache
def _widest_bin(gap: float) -> int:
    """The most cells of which three are no wider than a gap, and many make up a turn."""
    return max(n for n in range(1, CELLS + 1) if CELLS % n == 0 and n <= max(1.0, gap / 3 / _CELL))


def _ignored(mount: CloudMount) -> Cells:
    cells = no_cells()
    for first, last in mount.ignore:
        cells |= sector(first, last, touched=True)
    return cells


def _cells(angles: NDArray[np.floating]) -> NDArray[np.intp]:
    found: NDArray[np.intp] = np.floor(angles * (1 / _CELL)).astype(np.intp) % CELLS
    return found
