"""Compiles what the service runs, ahead of time: ``python -m skytether_services.navigation.precompile``.

An image does this when it is built; what is compiled is kept in ``NUMBA_CACHE_DIR``, so a start has not to wait for it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skytether.control.admittance import STANDSTILL
from skytether_services.planar.geometry import Pose, advance

from .grid_map import FREE, OCCUPIED, GridMap
from .map_builder import MapBuilder
from .navigator import Navigator
from .params import ControllerName, Params
from .senses import LaserScan
from .status import State

_SIDE, _RESOLUTION = 8.0, 0.05
_PERIOD = 1 / 30
_ANGLES = np.linspace(-2.0, 2.0, 121)
_FROM, _TO = Pose(2.0, 2.0, 0.0), Pose(6.0, 5.5, 1.5)


def precompile() -> None:
    """Drive through a small room with each controller, from a given pose and from an unknown one, and map it.

    Raises:
        RuntimeError: It did not get to its goal, or there was no map.
    """
    for controller in ControllerName:
        if not _drive(replace(Params(), controller=controller), _FROM, seconds=60.0):
            raise RuntimeError(f"the drive with the controller {controller} did not reach its goal")
    _drive(replace(Params(), controller=ControllerName.DWA), None, seconds=10.0)
    if not _map():
        raise RuntimeError("no map was built")


def room() -> GridMap:
    """Four walls and a corner that sticks out, which no turn maps onto itself."""
    cells = round(_SIDE / _RESOLUTION)
    grid = np.full((cells, cells), FREE, dtype=np.int8)
    grid[:2] = grid[-2:] = grid[:, :2] = grid[:, -2:] = OCCUPIED
    grid[100:, :50] = OCCUPIED
    grid[:30, 110:] = OCCUPIED
    return GridMap(grid, _RESOLUTION)


def _scan(grid: GridMap, pose: Pose, now: float) -> LaserScan:
    """What a laser at the robot's centre sees; marched along each ray, so slow, and it compiles nothing."""
    steps = np.arange(0.1, 1.5 * _SIDE, 0.5 * _RESOLUTION)
    angles = pose.yaw + _ANGLES
    x = pose.x + steps[None, :] * np.cos(angles)[:, None]
    y = pose.y + steps[None, :] * np.sin(angles)[:, None]
    points = np.column_stack((x.ravel(), y.ravel()))
    columns, rows = np.clip(grid.to_cells(points).astype(int), 0, grid.rows - 1).T
    hit = (grid.cells[rows, columns] == OCCUPIED).reshape(x.shape)
    ranges: NDArray[np.float32] = steps[hit.argmax(axis=1)].astype(np.float32)
    start = float(_ANGLES[0])
    return LaserScan(now, now, ranges, start, float(_ANGLES[1]) - start, 0.05, 30.0, Pose(0.0, 0.0, 0.0))


def _drive(params: Params, start: Pose | None, *, seconds: float) -> bool:
    """Whether a robot that does exactly as it is told comes to the goal."""
    grid, navigator = room(), Navigator(params)
    navigator.use_map(grid)
    if start is not None:
        navigator.place(start)
    navigator.go([_TO])
    pose, velocity = start or _FROM, STANDSTILL
    for number in range(round(seconds / _PERIOD)):
        now = 1000.0 + number * _PERIOD
        navigator.whereabouts.odometry(now, pose, now, velocity)
        if number % 4 == 0:
            navigator.whereabouts.scan(_scan(grid, pose, now))
        velocity = navigator.step(now, 0.0)
        if start is None:
            velocity = velocity._replace(linear=0.2, angular=0.3 * math.sin(0.05 * number))
        elif navigator.report().doing is State.SUCCEEDED:
            return True
        pose = advance(pose, velocity.linear, velocity.angular, _PERIOD)
    return False


def _map() -> bool:
    """Whether a map comes of two rounds through the room; a loop is looked for in the second."""
    grid, builder = room(), MapBuilder(Pose(5.0, 4.0, 0.5 * math.pi))
    for number in range(90):
        angle = 0.15 * number
        pose = Pose(4.0 + math.cos(angle), 4.0 + math.sin(angle), angle + 0.5 * math.pi)
        builder.add(_scan(grid, pose, 0.1 * number), pose)
    return builder.grid() is not None


if __name__ == "__main__":
    precompile()
