"""Where in a map a scan could be: every free place and heading, coarsely, then the best of them finely.

It seeds the particle filter where nothing is known of the pose. What it compares may be the scans of some metres of
driving put together, which fit fewer places than a single one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skytether_services.navigation.compiled import compiled
from skytether_services.navigation.likelihood_field import (
    Explained,
    LikelihoodField,
    explain,
    score_beams,
    to_cell_poses,
)
from skytether_services.navigation.poses import wrap
from skytether_services.navigation.scan_align import align

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SearchParams:
    """How a map is searched.

    Attributes:
        thinned: Of the points that lie in a square of this side one is kept [m].
        spacing: Of the places that are tried [m].
        turn: Of the headings [rad].
        sigma: Standard deviation of a point in the coarse comparison: covers the spacing [m].
        points: So many points are compared coarsely.
        sifted: So many of the best places by their points alone are compared by beams, which pass no wall.
        beams: So many beams of each.
        seeds: So many of the best by beams are looked at finely.
        judged: By so many beams of each; the hypotheses by all.
        hypotheses: So many different ones are returned at most.
        apart: Nearer ones are the same place [m].
        apart_turn: And the same heading [rad].
    """

    thinned: float = 0.15
    spacing: float = 0.25
    turn: float = math.radians(4)
    sigma: float = 0.25
    points: int = 150
    sifted: int = 4000
    beams: int = 60
    seeds: int = 100
    judged: int = 600
    hypotheses: int = 12
    apart: float = 0.6
    apart_turn: float = math.radians(20)


@dataclass(frozen=True)
class Hypothesis:
    """A place that a scan fits.

    Attributes:
        pose: x [m], y [m], heading [rad], map frame.
        score: Mean log-likelihood of a beam; one through a wall counts as an outlier.
        explained: How the map explains the beams from there.
    """

    pose: Array
    score: float
    explained: Explained


@compiled
def _sweep(
    score: NDArray[np.int16], places: NDArray[np.int32], offsets: NDArray[np.int32], best: NDArray[np.int64]
) -> None:
    """For each heading (first axis of offsets) and place the sum over points; places by headings."""
    rows, columns = score.shape
    for place in range(places.shape[0]):
        for turn in range(offsets.shape[0]):
            total = 0
            for point in range(offsets.shape[1]):
                column = places[place, 0] + offsets[turn, point, 0]
                row = places[place, 1] + offsets[turn, point, 1]
                if 0 <= row < rows and 0 <= column < columns:
                    total += score[row, column]
            best[place, turn] = total


def search(
    field: LikelihoodField,
    starts: Array,
    ends: Array,
    random: np.random.Generator,
    params: SearchParams | None = None,
    also: Sequence[Array] = (),
) -> list[Hypothesis]:
    """Places that a scan fits, the best first.

    Args:
        field: Of the map.
        starts: m by 2: where each beam starts, in the robot's frame [m].
        ends: m by 2: where it ends [m].
        random: Which points and beams are compared.
        params: How to search.
        also: Poses that are looked at in any case.
    """
    params = params or SearchParams()
    if len(ends) == 0 or len(field.free) == 0:
        return []
    squares = np.floor(ends / params.thinned).astype(np.int64)
    _, kept = np.unique(squares[:, 0] * 2_000_003 + squares[:, 1], return_index=True)
    spread, beams = random.permutation(kept), random.permutation(len(ends))
    places = _coarse(field, ends[spread[: params.points]], params)
    few, more = beams[: params.beams], beams[: params.judged]
    seeds = _sift(field, starts[few], ends[few], places, params)
    found = [
        judge(field, pose, starts[more], ends[more])
        for pose in _aligned(field, ends[spread[: 4 * params.points]], np.array([*also, *seeds]), params)
    ]
    found.sort(key=lambda hypothesis: -hypothesis.score)
    poses = np.array([hypothesis.pose for hypothesis in found])
    best = poses[distinct(poses, params.apart, params.apart_turn, params.hypotheses)]
    return sorted((judge(field, pose, starts, ends) for pose in best), key=lambda hypothesis: -hypothesis.score)


def _coarse(field: LikelihoodField, points: Array, params: SearchParams) -> Array:
    """Poses of the best places, n by 3, map frame."""
    resolution = field.grid.resolution
    # Neutral where nothing is known, so zero; above it what is near an obstacle, below it what is in the open.
    soft = np.exp(-(field.distance**2) / (2 * params.sigma**2))
    score = np.where(field.known != 0, np.rint(100 * soft - 40), 0).astype(np.int16)
    stride = max(1, round(params.spacing / resolution))
    # A place for each square of the spacing that has a free cell: its middle.
    squares = np.unique(field.free // stride, axis=0)
    places = (squares * stride + stride // 2).astype(np.int32)
    turns = round(2 * math.pi / params.turn)
    headings = np.arange(turns) * (2 * math.pi / turns)
    cos, sin = np.cos(headings)[:, None], np.sin(headings)[:, None]
    offsets = np.stack((cos * points[:, 0] - sin * points[:, 1], sin * points[:, 0] + cos * points[:, 1]), axis=-1)
    offsets = np.rint(offsets / resolution).astype(np.int32)
    best = np.empty((len(places), turns), np.int64)
    _sweep(score, places, offsets, best)
    # The best of its neighbourhood in heading alone; the fine step makes one of neighbours in place.
    peak = (best >= np.roll(best, 1, axis=1)) & (best >= np.roll(best, -1, axis=1))
    flat = np.where(peak, best, -(2**40)).ravel()
    count = min(params.sifted, flat.size)
    place, turn = np.divmod(np.argpartition(-flat, count - 1)[:count], turns)
    return np.column_stack(
        (field.grid.to_points(places[place].astype(np.float64) + 0.5), headings[turn] + field.grid.origin[2])
    )


def _sift(field: LikelihoodField, starts: Array, ends: Array, poses: Array, params: SearchParams) -> Array:
    """The best of the poses, by beams: points alone fit through walls, and where the map knows little."""
    scores = score_beams(field, poses, starts, ends, params.sigma)
    poses = poses[np.argsort(-scores, kind="stable")]
    return poses[distinct(poses, 1.5 * params.spacing, 1.5 * params.turn, params.seeds)]


def _aligned(field: LikelihoodField, points: Array, seeds: Array, params: SearchParams) -> list[Array]:
    """Each of the poses, where the points fit best near it."""
    resolution = field.grid.resolution
    distance = field.distance / np.float32(resolution)
    information = np.diag([1 / (params.spacing / resolution) ** 2] * 2 + [1 / params.turn**2])
    found = []
    for at in to_cell_poses(field.grid, seeds):
        pose = at
        for sigma in (params.sigma, field.model.sigma):
            pose, _, _ = align(distance, points / resolution, pose, information, sigma / resolution, 0.2, 10)
        place = field.grid.to_points(pose[None, :2])[0]
        found.append(np.array([place[0], place[1], float(wrap(pose[2] + field.grid.origin[2]))]))
    return found


def judge(field: LikelihoodField, pose: Array, starts: Array, ends: Array) -> Hypothesis:
    """How well beams fit the map from one pose: the score by which hypotheses are compared."""
    explained = explain(field, pose, starts, ends)
    if len(ends) == 0:
        return Hypothesis(pose, math.log(field.model.unknown), explained)
    near = math.log(field.model.outlier)
    share = explained.known * explained.share
    # Explained beams count 0, what the map does not know a little, the rest as outliers.
    score = (1 - explained.known) * math.log(field.model.unknown) + (explained.known - share) * near
    return Hypothesis(pose, score, explained)


def distinct(poses: Array, apart: float, apart_turn: float, count: int) -> list[int]:
    """Indices of poses, in their order, without those that are near one before them."""
    kept: list[int] = []
    for index, pose in enumerate(poses):
        if kept:
            away = poses[kept] - pose
            same = (np.hypot(away[:, 0], away[:, 1]) < apart) & (np.abs(wrap(away[:, 2])) < apart_turn)
            if same.any():
                continue
        kept.append(index)
        if len(kept) == count:
            break
    return kept
