"""Occupancy from scans at known poses: each beam says that its cells are free, and the last one occupied."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skytether_services.navigation.compiled import compiled
from skytether_services.navigation.grid_map import FREE, OCCUPIED, UNKNOWN, GridMap


@dataclass(frozen=True)
class Beams:
    """How a laser's ranges are to be read.

    Attributes:
        first: Bearing of the first range from the laser's x axis [rad].
        step: From one range to the next [rad].
        max_range: Ranges from here on met nothing, as NaN and what is not positive [m].
        mount: Pose of the laser on the robot: x [m], y [m], yaw [rad].
    """

    first: float
    step: float
    max_range: float
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)


@compiled
def count_beams(
    hits: NDArray[np.int32], passes: NDArray[np.int32], x: float, y: float, ends: NDArray[np.float64], count_end: bool
) -> None:
    """Walk along beams through a grid and count, in place, where each passed and where it ended.

    A cell is visited once for each beam. What lies off the grid is left out.

    Args:
        hits: Rows by columns; how often a beam ended in the cell.
        passes: As ``hits``; how often one passed through it.
        x: Column of the beams' start, in cells.
        y: Row of it.
        ends: n by 2: column and row of their ends.
        count_end: Whether the ends are hits.
    """
    rows, columns = hits.shape
    for index in range(ends.shape[0]):
        dx = ends[index, 0] - x
        dy = ends[index, 1] - y
        column, row = math.floor(x), math.floor(y)
        last_column, last_row = math.floor(ends[index, 0]), math.floor(ends[index, 1])
        # Amanatides and Woo 1987: from border to border, whichever is next.
        step_x = 1 if dx > 0 else -1
        step_y = 1 if dy > 0 else -1
        per_x = abs(1.0 / dx) if dx != 0 else np.inf
        per_y = abs(1.0 / dy) if dy != 0 else np.inf
        next_x = ((column + 1 - x) if dx > 0 else (x - column)) * per_x if dx != 0 else np.inf
        next_y = ((row + 1 - y) if dy > 0 else (y - row)) * per_y if dy != 0 else np.inf
        for _ in range(abs(last_column - column) + abs(last_row - row)):
            if 0 <= row < rows and 0 <= column < columns:
                passes[row, column] += 1
            if next_x < next_y:
                next_x += per_x
                column += step_x
            else:
                next_y += per_y
                row += step_y
        if count_end and 0 <= last_row < rows and 0 <= last_column < columns:
            hits[last_row, last_column] += 1


def beam_ends(
    ranges: NDArray[np.float64], beams: Beams, pose: NDArray[np.float64], longest: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where the beams of a scan end, in the frame of ``pose`` [m]: those that met something, and those that did not.

    Args:
        ranges: As measured [m].
        beams: How to read them.
        pose: Of the robot: x [m], y [m], heading [rad].
        longest: A beam is cut off here, and then has met nothing [m].
    """
    angles = beams.first + beams.step * np.arange(len(ranges)) + beams.mount[2] + pose[2]
    with np.errstate(invalid="ignore"):
        met = (ranges > 0) & (ranges < beams.max_range)
    length = np.minimum(np.where(met, ranges, 0.0), longest)
    x, y = laser_position(beams, pose)
    ends = np.column_stack((x + length * np.cos(angles), y + length * np.sin(angles)))
    hit = met & (ranges <= longest)
    return ends[hit], ends[met & ~hit]


def laser_position(beams: Beams, pose: NDArray[np.float64]) -> tuple[float, float]:
    """Where the laser is, when the robot is at ``pose`` [m]."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return (
        float(pose[0] + cos * beams.mount[0] - sin * beams.mount[1]),
        float(pose[1] + sin * beams.mount[0] + cos * beams.mount[1]),
    )


def map_from_scans(
    scans: NDArray[np.float64],
    poses: NDArray[np.float64],
    beams: Beams,
    *,
    resolution: float = 0.05,
    longest: float = 20.0,
    margin: float = 1.0,
    occupied_share: float = 0.25,
) -> GridMap:
    """The map that scans at known poses show.

    Args:
        scans: Scans by ranges [m].
        poses: Scans by 3: x [m], y [m], heading [rad].
        beams: How to read the ranges.
        resolution: Side of a cell [m].
        longest: Of a beam only as much is used [m].
        margin: Around all that was seen [m].
        occupied_share: A cell is occupied when more than this share of the beams in it ended there. Walls that beams
            graze keep it low.
    """
    ends = [beam_ends(scan, beams, pose, longest) for scan, pose in zip(scans, poses, strict=True)]
    seen = np.vstack([poses[:, :2], *(hit for hit, _ in ends), *(miss for _, miss in ends)])
    low = np.floor((seen.min(axis=0) - margin) / resolution) * resolution
    columns, rows = (np.ceil((seen.max(axis=0) + margin - low) / resolution)).astype(int)
    hits = np.zeros((rows, columns), np.int32)
    passes = np.zeros((rows, columns), np.int32)
    for pose, (hit, miss) in zip(poses, ends, strict=True):
        x, y = (np.array(laser_position(beams, pose)) - low) / resolution
        count_beams(hits, passes, x, y, (hit - low) / resolution, True)
        count_beams(hits, passes, x, y, (miss - low) / resolution, False)
    total = hits + passes
    cells = np.full((rows, columns), UNKNOWN, np.int8)
    cells[total > 0] = FREE
    cells[(total > 0) & (hits > occupied_share * total)] = OCCUPIED
    return GridMap(cells, resolution, (float(low[0]), float(low[1]), 0.0))
