"""Where in a map a scan could be: every free place and heading, coarsely, then the best of them finely.

It seeds the particle filter where nothing is known of the pose. What it compares may be the scans of some metres of
driving put together, which fit fewer places than a single one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from skytether_services.navigation.compiled import compiled
from skytether_services.navigation.likelihood_field import (
    Explained,
    LikelihoodField,
    blurred_likelihood,
    explain,
    score_beams,
    to_cell_poses,
)
from skytether_services.navigation.poses import between, compose, wrap
from skytether_services.navigation.scan_align import align
from skytether_services.navigation.seen_floor import Floor, seen_floor

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
        sifted: So many of the best places by their points alone are compared by beams, which pass no wall, and so many
            of these once more.
        beams: By so many beams of each, and then by so many.
        seeds: So many of the best by beams are looked at finely.
        judged: By so many beams of each; the hypotheses by all.
        climb: First and last step with which a hypothesis is moved to where it explains the most [m]; each is half of
            the one before.
        climb_turn: Turn that goes with a step of a metre [rad/m].
        hypotheses: So many different ones are returned at most.
        apart: Nearer ones are the same place [m].
        apart_turn: And the same heading [rad].
    """

    thinned: float = 0.15
    spacing: float = 0.25
    turn: float = math.radians(4)
    sigma: float = 0.25
    points: int = 150
    sifted: tuple[int, int] = (20_000, 3000)
    beams: tuple[int, int] = (30, 150)
    seeds: int = 100
    judged: int = 600
    climb: tuple[float, float] = (0.1, 0.025)
    climb_turn: float = 0.3
    hypotheses: int = 12
    apart: float = 0.6
    apart_turn: float = math.radians(20)


@dataclass(frozen=True)
class Hypothesis:
    """A place that a scan fits.

    Attributes:
        pose: x [m], y [m], heading [rad], map frame.
        score: Mean log-likelihood of a beam; one through a wall counts as an outlier, one that ends in the open as a
            little more. Less what the map says against the floor that was seen.
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
    way: Array | None = None,
    from_first: bool = False,
) -> list[Hypothesis]:
    """Places that a scan fits, the best first.

    Args:
        field: Of the map.
        starts: m by 2: where each beam starts, in the robot's frame [m].
        ends: m by 2: where it ends [m].
        random: Which points and beams are compared.
        params: How to search.
        also: Poses that are looked at in any case.
        way: n by 3: where the robot was, oldest first, in its frame now [m, rad]; None: only here.
        from_first: The places that are tried are of the oldest of these, not of the robot now. Only places that the map
            shows as free are tried, and the robot may have left what the map knows.
    """
    params = params or SearchParams()
    if len(ends) == 0 or len(field.free) == 0:
        return []
    squares = np.floor(ends / params.thinned).astype(np.int64)
    _, kept = np.unique(squares[:, 0] * 2_000_003 + squares[:, 1], return_index=True)
    spread, beams = random.permutation(kept), random.permutation(len(ends))
    way = np.zeros((1, 3)) if way is None else way
    home = between(way[0], np.zeros(3)) if from_first else np.zeros(3)
    points = np.pad(ends[spread[: params.points]], ((0, 0), (0, 1)))
    places = compose(_coarse(field, compose(home, points)[:, :2], params), home)
    more = beams[: params.judged]
    seeds = _sift(field, starts[spread], ends[spread], places, params)
    floor = Floor(seen_floor(starts, ends), way[:, :2])
    found = [
        judge(field, pose, starts[more], ends[more], floor)
        for pose in _aligned(field, ends[spread[: 4 * params.points]], np.array([*also, *seeds]), params)
    ]
    found.sort(key=lambda hypothesis: -hypothesis.score)
    poses = np.array([hypothesis.pose for hypothesis in found])
    best = [found[index] for index in distinct(poses, params.apart, params.apart_turn, params.hypotheses)]
    best = [_climb(field, hypothesis, starts[more], ends[more], floor, params) for hypothesis in best]
    best = [judge(field, one.pose, starts, ends, floor) for one in best]
    best.sort(key=lambda hypothesis: -hypothesis.score)
    # Two may have moved to the same place.
    poses = np.array([hypothesis.pose for hypothesis in best])
    return [best[index] for index in distinct(poses, params.apart, params.apart_turn, params.hypotheses)]


def _coarse(field: LikelihoodField, points: Array, params: SearchParams) -> Array:
    """Poses of the best places, n by 3, map frame."""
    resolution = field.grid.resolution
    # Nothing is known: zero; above it what is near an obstacle, below it what is in the open.
    likelihood = blurred_likelihood(field, params.sigma) / field.model.unknown
    score = np.rint(100 * np.log(likelihood)).astype(np.int16)
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
    count = min(params.sifted[0], flat.size)
    place, turn = np.divmod(np.argpartition(-flat, count - 1)[:count], turns)
    return np.column_stack(
        (field.grid.to_points(places[place].astype(np.float64) + 0.5), headings[turn] + field.grid.origin[2])
    )


def _sift(field: LikelihoodField, starts: Array, ends: Array, poses: Array, params: SearchParams) -> Array:
    """The best of the poses, by beams: points alone fit through walls, and where the map knows little."""
    for count, beams in zip((params.sifted[1], len(poses)), params.beams, strict=True):
        scores = score_beams(field, poses, starts[:beams], ends[:beams], params.sigma)
        poses = poses[np.argsort(-scores, kind="stable")[:count]]
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


def _climb(
    field: LikelihoodField, best: Hypothesis, starts: Array, ends: Array, floor: Floor, params: SearchParams
) -> Hypothesis:
    """Move a hypothesis to where its score is best near it: points alone are drawn to what stands behind walls, too."""
    size, last = params.climb
    for _ in range(_CLIMBS):
        if size < last:
            break
        tried = [best.pose + size * step * (1, 1, params.climb_turn) for step in _STEPS]
        found = max(
            (judge(field, pose, starts, ends, floor) for pose in tried), key=lambda hypothesis: hypothesis.score
        )
        if found.score > best.score:
            best = found
        else:
            size /= 2
    return replace(best, pose=np.array([*best.pose[:2], float(wrap(best.pose[2]))]))


_CLIMBS = 40
"""Steps and halvings at most."""
_STEPS = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], float)


_OPEN = 0.03
"""Likelihood of a beam that ends in the open, where hypotheses are compared: it met something that the map lacks.

From the right pose 5 % of the beams do and 7 % pass through something, from a wrong one 15 and 17 % (building 079).
"""


def judge(field: LikelihoodField, pose: Array, starts: Array, ends: Array, floor: Floor) -> Hypothesis:
    """How well beams and the floor that they crossed fit the map from one pose: by that score hypotheses are compared.

    Args:
        field: Of the map.
        pose: x [m], y [m], heading [rad], map frame.
        starts: m by 2: where each beam starts, in the robot's frame [m].
        ends: m by 2: where it ends [m].
        floor: That they crossed, and that the robot drove on.
    """
    against = floor.against(field, pose)
    explained = explain(field, pose, starts, ends)
    if len(ends) == 0:
        return Hypothesis(pose, math.log(field.model.unknown) - against, explained)
    through = explained.known * explained.through
    in_open = explained.known * (1 - explained.share) - through
    # Explained beams count 0, what the map does not know a little.
    score = (
        (1 - explained.known) * math.log(field.model.unknown)
        + through * math.log(field.model.outlier)
        + in_open * math.log(_OPEN)
    )
    return Hypothesis(pose, score - against, explained)


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
