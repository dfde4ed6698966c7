"""Likelihood field of a map (Probabilistic Robotics, 6.4): how well beams end where the map has obstacles."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from skytether_services.navigation.compiled import compiled
from skytether_services.navigation.grid_map import GridMap

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BeamModel:
    """What the end of a beam says.

    Attributes:
        sigma: Standard deviation of an end from the obstacle that it met, errors of the map included [m].
        outlier: Likelihood of an end far from all obstacles, of one on an obstacle being 1: people, moved furniture.
        unknown: Likelihood of an end where the map knows nothing: says little either way.
        explained: An end as near as this to an obstacle is explained by the map [m].
        max_distance: Distances are cut off here [m].
    """

    sigma: float = 0.10
    outlier: float = 0.05
    unknown: float = 0.3
    explained: float = 0.2
    max_distance: float = 1.0


@dataclass(frozen=True)
class LikelihoodField:
    """A map, ready for scans to be compared with.

    Attributes:
        distance: Rows by columns; from a cell's middle to the nearest occupied one [m], cut off.
        log_likelihood: Of a beam that ends in the cell.
        known: 1 where the map has seen the cell, or an obstacle is near enough to explain an end there.
        free: n by 2: column and row of all free cells.
        grid: The map.
        model: What it was made with.
    """

    distance: NDArray[np.float32]
    log_likelihood: NDArray[np.float32]
    known: NDArray[np.uint8]
    free: NDArray[np.int32]
    grid: GridMap
    model: BeamModel


def likelihood_field(grid: GridMap, model: BeamModel | None = None) -> LikelihoodField:
    """The field of a map, by OpenCV's distance transform."""
    model = model or BeamModel()
    empty = (grid.cells < 50).astype(np.uint8)
    distance = cv2.distanceTransform(empty, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * np.float32(grid.resolution)
    distance = np.minimum(distance, np.float32(model.max_distance))
    hit = np.exp(-(distance**2) / (2 * model.sigma**2))
    known = (grid.cells >= 0) | (distance <= model.explained)
    likelihood = np.where(known, model.outlier + (1 - model.outlier) * hit, model.unknown)
    rows, columns = np.nonzero((grid.cells >= 0) & (grid.cells < 50))
    return LikelihoodField(
        distance=distance.astype(np.float32),
        log_likelihood=np.log(likelihood).astype(np.float32),
        known=known.astype(np.uint8),
        free=np.column_stack((columns, rows)).astype(np.int32),
        grid=grid,
        model=model,
    )


@compiled
def _score(log_likelihood: NDArray[np.float32], unknown: float, cells: Array, points: Array, total: Array) -> None:
    rows, columns = log_likelihood.shape
    for index in range(cells.shape[0]):
        cos, sin = math.cos(cells[index, 2]), math.sin(cells[index, 2])
        x, y = cells[index, 0], cells[index, 1]
        sum_all = 0.0
        for beam in range(points.shape[0]):
            column = math.floor(x + cos * points[beam, 0] - sin * points[beam, 1])
            row = math.floor(y + sin * points[beam, 0] + cos * points[beam, 1])
            if 0 <= row < rows and 0 <= column < columns:
                sum_all += log_likelihood[row, column]
            else:
                sum_all += unknown
        total[index] = sum_all


def score_poses(field: LikelihoodField, poses: Array, points: Array) -> Array:
    """How well points fit the map from each of many poses.

    Args:
        field: Of the map.
        poses: n by 3: x [m], y [m], heading [rad], map frame.
        points: m by 2, in the robot's frame [m].

    Returns:
        For each pose the sum of the points' log-likelihoods.
    """
    cells = to_cell_poses(field.grid, poses)
    total = np.empty(len(poses))
    unknown = math.log(field.model.unknown)
    _score(field.log_likelihood, unknown, cells, points / field.grid.resolution, total)
    return total


@compiled
def _score_beams(
    log_likelihood: NDArray[np.float32],
    cells: NDArray[np.int8],
    limits: tuple[float, float],
    poses: Array,
    starts: Array,
    ends: Array,
    short_of_end: float,
    total: Array,
) -> None:
    """``limits``: log-likelihood of a beam through a wall, and of one that ends off the map."""
    rows, columns = log_likelihood.shape
    for index in range(poses.shape[0]):
        cos, sin = math.cos(poses[index, 2]), math.sin(poses[index, 2])
        x, y = poses[index, 0], poses[index, 1]
        sum_all = 0.0
        for beam in range(ends.shape[0]):
            ax = x + cos * starts[beam, 0] - sin * starts[beam, 1]
            ay = y + sin * starts[beam, 0] + cos * starts[beam, 1]
            bx = x + cos * ends[beam, 0] - sin * ends[beam, 1]
            by = y + sin * ends[beam, 0] + cos * ends[beam, 1]
            length = math.hypot(bx - ax, by - ay)
            passed = False
            for step in range(int(length - short_of_end)):
                column = math.floor(ax + step / length * (bx - ax))
                row = math.floor(ay + step / length * (by - ay))
                if 0 <= row < rows and 0 <= column < columns and cells[row, column] >= 50:
                    passed = True
                    break
            column, row = math.floor(bx), math.floor(by)
            if passed:
                sum_all += limits[0]
            elif 0 <= row < rows and 0 <= column < columns:
                sum_all += log_likelihood[row, column]
            else:
                sum_all += limits[1]
        total[index] = sum_all


def blurred_likelihood(field: LikelihoodField, sigma: float) -> Array:
    """Of a beam that ends in the cell, as seen from a pose that is some way off: rows by columns.

    Args:
        field: Of the map.
        sigma: Standard deviation of an end from its obstacle, the error of the pose included [m].
    """
    model = field.model
    hit = np.exp(-(field.distance**2) / (2 * sigma**2))
    known = (field.grid.cells >= 0) | (field.distance <= sigma)
    return np.where(known, model.outlier + (1 - model.outlier) * hit, model.unknown)


def score_beams(field: LikelihoodField, poses: Array, starts: Array, ends: Array, sigma: float) -> Array:
    """How well beams fit the map from each of many poses that are some way off; one through a wall is an outlier.

    Args:
        field: Of the map.
        poses: n by 3: x [m], y [m], heading [rad], map frame.
        starts: m by 2: where each beam starts, in the robot's frame [m].
        ends: m by 2: where it ends [m].
        sigma: Standard deviation of an end from its obstacle, the error of the poses included [m].

    Returns:
        For each pose the sum of the beams' log-likelihoods.
    """
    model, resolution = field.model, field.grid.resolution
    likelihood = blurred_likelihood(field, sigma)
    total = np.empty(len(poses))
    _score_beams(
        np.log(likelihood).astype(np.float32),
        field.grid.cells,
        (math.log(model.outlier), math.log(model.unknown)),
        to_cell_poses(field.grid, poses),
        starts / resolution,
        ends / resolution,
        2 * sigma / resolution,
        total,
    )
    return total


def to_cell_poses(grid: GridMap, poses: Array) -> Array:
    """Poses of the map frame as column, row [cells] and heading from the map's own x axis [rad]."""
    return np.column_stack((grid.to_cells(poses[:, :2]), poses[:, 2] - grid.origin[2]))


UNKNOWN, EXPLAINED, OPEN, THROUGH = 0, 1, 2, 3
"""What a map says of a beam: nothing; ends at an obstacle, seen from its free side; ends in the open; passes one."""


@compiled
def _compare(
    distance: NDArray[np.float32],
    known: NDArray[np.uint8],
    cells: NDArray[np.int8],
    pose: Array,
    starts: Array,
    ends: Array,
    near: float,
    short_of_end: float,
) -> NDArray[np.int8]:
    rows, columns = distance.shape
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    result = np.zeros(ends.shape[0], np.int8)
    for beam in range(ends.shape[0]):
        ax = pose[0] + cos * starts[beam, 0] - sin * starts[beam, 1]
        ay = pose[1] + sin * starts[beam, 0] + cos * starts[beam, 1]
        bx = pose[0] + cos * ends[beam, 0] - sin * ends[beam, 1]
        by = pose[1] + sin * ends[beam, 0] + cos * ends[beam, 1]
        length = math.hypot(bx - ax, by - ay)
        reach = length - short_of_end
        for step in range(int(reach * 2)):
            share = step / (2.0 * length)
            column = math.floor(ax + share * (bx - ax))
            row = math.floor(ay + share * (by - ay))
            if 0 <= row < rows and 0 <= column < columns and cells[row, column] >= 50:
                result[beam] = THROUGH
                break
        if result[beam] == THROUGH:
            continue
        column, row = math.floor(bx), math.floor(by)
        if not (0 <= row < rows and 0 <= column < columns and known[row, column] != 0):
            continue
        if distance[row, column] > near:
            result[beam] = OPEN
            continue
        # A wall that was only ever seen from its other side says nothing exact: it is as far off as it is thick.
        share = max(reach, 0.0) / max(length, 1e-9)
        column, row = math.floor(ax + share * (bx - ax)), math.floor(ay + share * (by - ay))
        if 0 <= row < rows and 0 <= column < columns and cells[row, column] >= 0:
            result[beam] = EXPLAINED
    return result


@dataclass(frozen=True)
class Explained:
    """How a map explains a scan from one pose.

    Attributes:
        known: Share of the beams about which the map says something.
        share: Share of those that end at an obstacle, and pass through none.
        through: Share of those that pass through an obstacle.
    """

    known: float
    share: float
    through: float

    @property
    def telling(self) -> float:
        """Share of the beams that speak for the pose, or against it.

        One that ends in the open met something that the map does not show. That says nothing of the pose.
        """
        return self.known * (self.share + self.through)

    @property
    def against(self) -> float:
        """Share of the telling beams that speak against the pose: they passed through what the map shows."""
        telling = self.share + self.through
        return self.through / telling if telling > 0 else 0.0


def compare_beams(field: LikelihoodField, pose: Array, starts: Array, ends: Array) -> NDArray[np.int8]:
    """What the map says of each beam from one pose: ``UNKNOWN``, ``EXPLAINED``, ``OPEN`` or ``THROUGH``.

    Args:
        field: Of the map.
        pose: x [m], y [m], heading [rad], map frame.
        starts: m by 2: where each beam starts, in the frame of ``pose`` [m].
        ends: m by 2: where it ends.
    """
    resolution = field.grid.resolution
    at = to_cell_poses(field.grid, pose[None, :])[0]
    return _compare(
        field.distance,
        field.known,
        field.grid.cells,
        at,
        starts / resolution,
        ends / resolution,
        field.model.explained,
        2 * field.model.explained / resolution,
    )


def explain(field: LikelihoodField, pose: Array, starts: Array, ends: Array) -> Explained:
    """Compare beams with the map from one pose, walls that they would have to pass included; see `compare_beams`."""
    if len(ends) == 0:
        return Explained(0.0, 0.0, 0.0)
    return summed_up(compare_beams(field, pose, starts, ends))


def summed_up(beams: NDArray[np.int8]) -> Explained:
    """Shares of what `compare_beams` said of each beam."""
    _, good, in_open, through = np.bincount(beams, minlength=4).tolist()
    known = good + in_open + through
    return Explained(known / max(len(beams), 1), good / max(known, 1), through / max(known, 1))
