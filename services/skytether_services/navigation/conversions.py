"""Between messages and what the algorithms work on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from skytether.messages import (
    Header,
    MapMetaData,
    OccupancyGrid,
    Path,
    Point,
    PoseArray,
    PoseStamped,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    Time,
    quaternion_from_yaw,
    yaw_of,
)
from skytether.messages import Pose as PoseMessage
from skytether_services.planar.geometry import Pose

from .costmap import INSCRIBED, Costmap
from .grid_map import MAX_CELLS, GridMap
from .navigator import Report
from .whereabouts import Whereabouts

if TYPE_CHECKING:
    from .mapping_mode import MappingMode

MAP_FRAME = "map"
SHOWN_PATH = 500
"""Poses of a path in its message, at most."""
_CELLS = np.array([round(98 * cost / (INSCRIBED - 1)) for cost in range(INSCRIBED)] + [99, 100, -1], dtype=np.int8)
"""By cost, as costmap_2d publishes them: 99 is inscribed, 100 lethal, -1 unknown."""


def pose_of(pose: PoseMessage) -> Pose:
    """In the plane."""
    return Pose(pose.position.x, pose.position.y, yaw_of(pose.orientation))


def first_pose(message: PoseWithCovarianceStamped) -> tuple[Pose, float, float]:
    """A pose that somebody gave, and its standard deviations [m, rad]; 0: not told."""
    covariance = message.pose.covariance
    spread, turn = max(float(covariance[0]), float(covariance[7])), float(covariance[35])
    return pose_of(message.pose.pose), _root(spread), _root(turn)


def grid_of(message: OccupancyGrid) -> GridMap | None:
    """A map; None if its size does not fit its cells, or is none."""
    info = message.info
    cells = np.asarray(message.data, dtype=np.int8)
    if not 0 < info.width * info.height == cells.size <= MAX_CELLS or info.resolution <= 0:
        return None
    x, y, yaw = pose_of(info.origin)
    try:
        return GridMap(cells.reshape(info.height, info.width).copy(), float(info.resolution), (x, y, yaw))
    except ValueError:
        return None


def is_map(frame: str) -> bool:
    """Whether a goal in this frame is on the map."""
    return frame.removeprefix("/") in ("", MAP_FRAME)


def other_frame(frame: str) -> str:
    """What to say of one that is not."""
    return f"A goal is in the frame '{frame}'; give it in '{MAP_FRAME}'."


def pose_stamped(pose: Pose, stamp: float) -> PoseStamped:
    """A pose on the map."""
    return PoseStamped(_header(stamp), _pose(np.array(pose)))


def path_message(path: NDArray[np.float64], stamp: float) -> Path:
    """A path on the map."""
    header = _header(stamp)
    if len(path) > SHOWN_PATH:
        path = path[np.linspace(0, len(path) - 1, SHOWN_PATH).astype(int)]
    return Path(header, tuple(PoseStamped(header, _pose(pose)) for pose in path))


def pose_message(pose: NDArray[np.float64], spread: NDArray[np.float64], stamp: float) -> PoseWithCovarianceStamped:
    """Where the robot is on the map, and the covariance of that, 3 by 3."""
    covariance = np.zeros(36)
    of = (0, 1, 5)
    for row in range(3):
        for column in range(3):
            covariance[6 * of[row] + of[column]] = spread[row, column]
    return PoseWithCovarianceStamped(_header(stamp), PoseWithCovariance(_pose(pose), covariance))


def particles_message(particles: NDArray[np.float64], stamp: float) -> PoseArray:
    """Where it may be."""
    return PoseArray(_header(stamp), tuple(_pose(pose) for pose in particles))


def costmap_message(costmap: Costmap, stamp: float) -> OccupancyGrid:
    """Costs from 0 to 98, 99 inscribed, 100 lethal, -1 unknown."""
    rows, columns = costmap.costs.shape
    header = _header(stamp)
    info = MapMetaData(header.stamp, costmap.resolution, columns, rows, PoseMessage(Point(*costmap.origin)))
    return OccupancyGrid(header, info, _CELLS[costmap.costs].ravel())


def map_message(grid: GridMap, stamp: float) -> OccupancyGrid:
    """A map, as `grid_of` reads it."""
    header = _header(stamp)
    info = MapMetaData(header.stamp, grid.resolution, grid.columns, grid.rows, _pose(np.array(grid.origin)))
    return OccupancyGrid(header, info, grid.cells.ravel())


def mapping_document(report: Report, mapping: MappingMode) -> dict[str, Any]:
    """The status of the mode that maps; documented in docs/navigation.md."""
    progress, pose = mapping.progress, mapping.pose()
    return {
        "state": str(report.doing),
        "code": report.code,
        "message": report.message,
        "scans": progress.scans if progress is not None else 0,
        "metres": round(progress.metres, 2) if progress is not None else 0.0,
        "loops": progress.loops if progress is not None else 0,
        "dropped": mapping.dropped,
        "pose": [round(value, 3) for value in pose] if pose is not None else None,
        "saved": str(mapping.saved) if mapping.saved is not None else None,
    }


def document(report: Report, whereabouts: Whereabouts, neighbours: Mapping[str, str]) -> dict[str, Any]:
    """The status, for programs; documented in docs/navigation.md."""
    task, estimate, state = report.task, whereabouts.estimate, whereabouts.state()
    # As new as odometry is: the estimate is of the last scan, 0.1 s old and more.
    pose = [round(value, 3) for value in state.pose] if estimate is not None and state is not None else None
    return {
        "state": str(report.doing),
        "code": report.code,
        "message": report.message,
        "goal": task.index + 1 if task is not None else 0,
        "goals": len(task.goals) if task is not None else 0,
        "round": task.round if task is not None else 0,
        "rounds": task.rounds if task is not None else 0,
        "target": [round(value, 3) for value in task.goal] if task is not None else None,
        "left_m": round(report.left, 2) if math.isfinite(report.left) else None,
        "behaviour": report.behaviour,
        "recoveries": report.recoveries,
        "pose": pose,
        "localised": estimate is not None and estimate.sure,
        "neighbours": dict(neighbours),
    }


def _header(stamp: float) -> Header:
    return Header(Time.from_seconds(stamp), MAP_FRAME)


def _pose(values: NDArray[np.float64]) -> PoseMessage:
    x, y, yaw = (float(value) for value in values)
    return PoseMessage(Point(x, y), quaternion_from_yaw(yaw))


def _root(variance: float) -> float:
    return math.sqrt(variance) if variance > 0 and math.isfinite(variance) else 0.0
