"""The global planner: from the robot to a goal over a costmap, as a smooth path, or why there is none."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from skytether.service import param
from skytether_services.planar.geometry import Pose

from .costmap import INSCRIBED, UNKNOWN, Costmap
from .footprint import FootprintChecks, misfits
from .search import relax, search, shortcut, walk_back

_TRIES = 6
"""Paths that are searched until the outline fits along one."""
_CLOSED = 0.15
"""So far around where it does not fit the next path must not lead [m]."""


@dataclass(frozen=True)
class PlannerParams:
    """How paths are searched and smoothed."""

    tolerance: float = param(
        0.25, unit="m", ge=0, doc="go to the nearest place within this, where the goal cannot be reached; 0: never"
    )
    start_tolerance: float = param(
        0.3, unit="m", ge=0, doc="a start in an obstacle (a pose is not exact) leaves it within this"
    )
    cost_weight: float = param(
        3.0, ge=0, doc="a way along an obstacle costs up to 1 + this times as much as one through free space"
    )
    allow_unknown: bool = param(True, doc="plan through what nobody has seen")
    spacing: float = param(0.05, unit="m", gt=0, doc="between neighbouring poses of the path")
    smoothing_rounds: int = param(40, ge=0, le=1000, doc="rounds over the path; 0 leaves its corners")
    margin: float = param(
        0.08, unit="m", ge=0, le=1, doc="a path that leaves so much room around the robot's outline is looked for,"
    )
    detour: float = param(
        10.0,
        unit="m",
        ge=0,
        doc="and taken if it is longer by no more than this; 0: the shortest is, as narrow as it is",
    )


class PlanStatus(StrEnum):
    """How a search for a path ended."""

    FOUND = "found"
    NOT_FINITE = "not_finite"
    START_OFF_MAP = "start_off_map"
    START_BLOCKED = "start_blocked"
    GOAL_OFF_MAP = "goal_off_map"
    GOAL_BLOCKED = "goal_blocked"
    NO_PATH = "no_path"


@dataclass(frozen=True)
class Plan:
    """A path, or why there is none.

    Attributes:
        status: How it ended.
        message: A sentence for people; empty if the goal itself is reached.
        path: n by 3: x [m], y [m], yaw [rad] along the path, the goal's own at its end; evenly spaced. Empty: none.
        goal: Where the path ends: within the tolerance of what was asked for. None: no path.
    """

    status: PlanStatus
    message: str = ""
    path: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    goal: Pose | None = None

    @property
    def length(self) -> float:
        """Of the path [m]."""
        return _length(self.path)


def plan(
    costmap: Costmap, start: Pose, goal: Pose, params: PlannerParams, checks: FootprintChecks | None = None
) -> Plan:
    """Search a path.

    A search over cells knows nothing of the robot's heading, so where the robot cannot turn its path may have a bend.
    With ``checks``, the outline is moved along the path; where it does not fit, another path is searched that leaves
    these places out.

    Args:
        costmap: Inflated.
        start: Of the robot.
        goal: In the same frame.
        params: How.
        checks: Of the outline with `PlannerParams.margin` around it; None: the path is not checked.
    """
    if not all(math.isfinite(value) for value in (*start, *goal)):
        return Plan(PlanStatus.NOT_FINITE, "The start or the goal has a coordinate that is not a finite number.")
    costs = np.ascontiguousarray(costmap.costs)
    first = costmap.cell(start.x, start.y)
    last = costmap.cell(goal.x, goal.y)
    if first is None:
        return Plan(PlanStatus.START_OFF_MAP, f"The robot, at {_at(start)}, is not on the map.")
    if last is None:
        return Plan(PlanStatus.GOAL_OFF_MAP, f"The goal {_at(goal)} is not on the map.")
    open_cells = costs < INSCRIBED
    if params.allow_unknown:
        open_cells |= costs == UNKNOWN
    if not open_cells[first]:
        free = _nearest(open_cells, first, params.start_tolerance / costmap.resolution)
        if free is None:
            near = f"{params.start_tolerance:g} m"
            text = f"The robot, at {_at(start)}, is in an obstacle, and nothing within {near} is free."
            return Plan(PlanStatus.START_BLOCKED, text)
        first = free
    columns = costs.shape[1]
    begin, end = first[0] * columns + first[1], last[0] * columns + last[1]
    reached = bool(open_cells[last])
    if reached:
        best, before = search(costs, begin, end, params.cost_weight, params.allow_unknown)
        reached = bool(np.isfinite(best[end]))
    message = ""
    if not reached:
        free = None
        if params.tolerance > 0:
            best, before = search(costs, begin, -1, params.cost_weight, params.allow_unknown)
            reachable = np.isfinite(best).reshape(costs.shape) & open_cells
            free = _nearest(reachable, last, params.tolerance / costmap.resolution)
        if free is None:
            if open_cells[last]:
                return Plan(PlanStatus.NO_PATH, f"No path leads from {_at(start)} to the goal {_at(goal)}.")
            text = f"The goal {_at(goal)} is in an obstacle, and no place within {params.tolerance:g} m can be reached."
            return Plan(PlanStatus.GOAL_BLOCKED, text)
        x, y = costmap.center(*free)
        why = "cannot be reached" if open_cells[last] else "is in an obstacle"
        goal, last = Pose(x, y, goal.yaw), free
        end = last[0] * columns + last[1]
        message = f"The goal {why}; the path ends at {_at(goal)}, the nearest place that can be reached."
    points = _points(before, end, columns)
    path = _smooth(costs, points, costmap, goal, params)
    if checks is not None and params.detour > 0:
        path = _roomy(costs, path, costmap, (begin, end), goal, params, checks)
    # Where the robot stands the path begins, if a straight piece leads there.
    if costmap.cell(start.x, start.y) == first:
        path[0, :2] = start[:2]
    return Plan(PlanStatus.FOUND, message, path, goal)


def resample(points: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Points on the same line, evenly apart by at most the spacing; both ends stay.

    Args:
        points: x, y, n by 2.
        spacing: In the same unit.
    """
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
    n = max(1, math.ceil(along[-1] / spacing - 1e-9))
    at = np.linspace(0.0, along[-1], n + 1)
    return np.column_stack((np.interp(at, along, points[:, 0]), np.interp(at, along, points[:, 1])))


def with_headings(points: NDArray[np.float64], last: float) -> NDArray[np.float64]:
    """Each point with the direction to the next one [rad], the last with its own: n by 3.

    Args:
        points: x, y, n by 2.
        last: Yaw at the end.
    """
    ahead = np.diff(points, axis=0)
    return np.column_stack((points, np.append(np.arctan2(ahead[:, 1], ahead[:, 0]), last)))


def _points(before: NDArray[np.int32], end: int, columns: int) -> NDArray[np.float64]:
    """(column, row) of a way's cells, their middles, n by 2."""
    way = walk_back(before, end)
    return np.column_stack((way % columns, way // columns)) + np.float64(0.5)


def _length(path: NDArray[np.float64]) -> float:
    return float(np.hypot(*np.diff(path[:, :2], axis=0).T).sum())


def _roomy(
    costs: NDArray[np.uint8],
    path: NDArray[np.float64],
    costmap: Costmap,
    ends: tuple[int, int],
    goal: Pose,
    params: PlannerParams,
    checks: FootprintChecks,
) -> NDArray[np.float64]:
    """The path, or one that is not much longer, along which the outline fits; the path itself where none is found."""
    frame, samples, check_from = checks.on(costmap)
    if not len(samples):
        return path  # what is round fits in its cells whichever way it faces
    longest = _length(path) + params.detour
    closed, tried = costs.copy(), path
    for _ in range(_TRIES):
        narrow = misfits(tried[:-1], costs, frame, samples, check_from)
        fits = np.flatnonzero(~narrow)
        # In the narrow place where the robot is, and in the one to which it is to go, it has no choice.
        narrow = narrow[fits[0] : fits[-1]] if len(fits) else narrow[:0]
        if not narrow.any():
            return tried if len(fits) else path
        for x, y in tried[fits[0] : fits[-1], :2][narrow].tolist():
            at = costmap.cell(x, y)
            if at is not None:
                cv2.circle(closed, at[::-1], math.ceil(_CLOSED / costmap.resolution), INSCRIBED, cv2.FILLED)
        best, before = search(closed, *ends, params.cost_weight, params.allow_unknown)
        if not np.isfinite(best[ends[1]]):
            return path
        tried = _smooth(closed, _points(before, ends[1], costs.shape[1]), costmap, goal, params)
        if _length(tried) > longest:
            return path
    return path


def _smooth(
    costs: NDArray[np.uint8], points: NDArray[np.float64], costmap: Costmap, goal: Pose, params: PlannerParams
) -> NDArray[np.float64]:
    unknown = params.allow_unknown
    spacing = params.spacing / costmap.resolution
    exact = (np.array(goal[:2]) - costmap.origin) / costmap.resolution
    if len(points) == 1:
        points = np.concatenate((points, exact[None]))
    else:
        points[-1] = exact
        kept = points[shortcut(costs, points, params.cost_weight, unknown, 200)]
        points = resample(kept, spacing)
        if params.smoothing_rounds:
            points = resample(relax(costs, points, 0.1, 0.3, params.smoothing_rounds, unknown), spacing)
    return with_headings(points * costmap.resolution + costmap.origin, goal.yaw)


def _nearest(cells: NDArray[np.bool_], to: tuple[int, int], reach: float) -> tuple[int, int] | None:
    """The nearest cell that is true, within so many cells; None if there is none."""
    rows, columns = cells.shape
    n = math.floor(reach)
    r0, r1 = max(to[0] - n, 0), min(to[0] + n + 1, rows)
    c0, c1 = max(to[1] - n, 0), min(to[1] + n + 1, columns)
    away = (np.arange(r0, r1)[:, None] - to[0]) ** 2 + (np.arange(c0, c1) - to[1]) ** 2
    away = np.where(cells[r0:r1, c0:c1], away, np.iinfo(np.int64).max)
    at = np.unravel_index(int(away.argmin()), away.shape)
    return (r0 + int(at[0]), c0 + int(at[1])) if away[at] <= reach * reach else None


def _at(pose: Pose) -> str:
    return f"({pose.x:.2f}, {pose.y:.2f})"
