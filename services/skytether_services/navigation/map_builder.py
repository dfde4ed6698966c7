"""A map that grows with each scan, and its files. No thread and no clock: `mapping_mode` has them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from skytether_services.planar.geometry import Pose
from skytether_services.planar.transforms import as_array, as_pose, compose, inverse, step

from .grid_map import FREE, OCCUPIED, UNKNOWN, GridMap, draw_map, save_map, save_png
from .log_odds import occupancy
from .mapping import Mapper
from .senses import LaserScan

MAX_SCANS = 200_000
"""Of one map: seven hours of driving at 8 Hz, 100 MB; the graph of them has far fewer."""
_STILL_M, _STILL_RAD = 0.01, 0.005
"""A robot that moved less since the last scan sees nothing new."""
_OCCUPIED_FROM = 65
"""Percent; as map_saver."""


class ScanError(ValueError):
    """A scan cannot become part of the map; the text says why."""


@dataclass(frozen=True, slots=True)
class Progress:
    """How far the map is.

    Attributes:
        pose: Of the robot on the map, at the last scan.
        scans: That were kept.
        metres: Way between them.
        loops: Places that were recognised.
    """

    pose: Pose
    scans: int
    metres: float
    loops: int


class MapBuilder:
    """Of one drive."""

    def __init__(self, start: Pose) -> None:
        """Begin with the robot at this pose of the map."""
        self._start = start
        self._mapper: Mapper | None = None
        self._first: LaserScan | None = None
        self._odometry = Pose(0.0, 0.0, 0.0)
        self._taken = 0
        self._kept: list[NDArray[np.float32]] = []

    def add(self, scan: LaserScan, odometry: Pose) -> Progress:
        """Take a scan, and the robot's dead reckoning of its moment.

        Raises:
            ScanError: It is of another laser than the first one, or the map is full.
        """
        if self._mapper is None or self._first is None:
            self._first = scan
            self._mapper = Mapper(start=as_array(compose(self._start, scan.laser)))
        elif _geometry(scan) != _geometry(self._first):
            raise ScanError("The laser's rays are others than those of the first scan; start a map anew for them.")
        elif self._taken >= MAX_SCANS:
            raise ScanError(f"The map has {MAX_SCANS:,} scans, as many as it can; save it, and start another one.")
        else:
            moved = step(self._odometry, odometry)
            if np.hypot(moved.x, moved.y) < _STILL_M and abs(moved.yaw) < _STILL_RAD:
                return self._progress(self._mapper, scan)
        self._odometry = odometry
        self._taken += 1
        with np.errstate(invalid="ignore"):
            ranges = np.where(scan.ranges >= scan.range_min, scan.ranges, np.nan).astype(np.float32)
        at = as_array(compose(odometry, scan.laser))
        if self._mapper.add(scan.stamp, ranges, _angles(scan), scan.range_max, at):
            self._kept.append(ranges)
        return self._progress(self._mapper, scan)

    def _progress(self, mapper: Mapper, scan: LaserScan) -> Progress:
        pose = compose(as_pose(mapper.pose), inverse(scan.laser))
        return Progress(pose, mapper.keyframes, mapper.travel, mapper.loops)

    def grid(self) -> GridMap | None:
        """Free, occupied and unknown, as the scans so far tell; None: none was kept."""
        if self._mapper is None or self._first is None or not self._kept:
            return None
        # Without matching all keyframes once more: that takes minutes after a long drive, and nobody waits for it here.
        found = self._mapper.finished(passes=0)
        poses = found.poses[found.keyframes]
        grid = occupancy(np.stack(self._kept), _angles(self._first), self._first.range_max, poses)
        # Few of the scans were kept: one beam through a cell has to be enough to call it free.
        cells = np.where(grid.cells < _OCCUPIED_FROM, UNKNOWN, OCCUPIED).astype(np.int8)
        cells[(grid.cells >= 0) & (grid.cells < 50)] = FREE
        return GridMap(cells, grid.resolution, grid.origin)


def save(grid: GridMap, path: Path) -> None:
    """Write NAME.yaml, NAME.pgm and NAME.png, each in one piece.

    Args:
        grid: The map.
        path: The YAML file.

    Raises:
        MapError: A file cannot be written.
    """
    save_png(path.with_suffix(".png"), draw_map(grid, scale=1))
    save_map(path, grid)


def _geometry(scan: LaserScan) -> tuple[object, ...]:
    return scan.ranges.size, scan.angle_min, scan.angle_increment


def _angles(scan: LaserScan) -> NDArray[np.float64]:
    return scan.angle_min + scan.angle_increment * np.arange(scan.ranges.size, dtype=np.float64)
