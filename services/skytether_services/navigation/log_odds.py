"""An occupancy grid from scans at known poses: beams that cross a cell, and beams that end there, make its odds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .compiled import compiled
from .grid_map import OCCUPIED, UNKNOWN, GridMap

Floats = NDArray[np.float64]

HIT, MISS = 0.85, -0.4
"""What a beam that ends in a cell, or goes through it, adds to the logarithm of its odds: 0.70 and 0.40 likely."""
_LIMIT = 4.0
_MAX_CELLS = 50_000_000


def occupancy(
    ranges: NDArray[np.float32],
    angles: Floats,
    max_range: float,
    poses: Floats,
    *,
    resolution: float = 0.05,
    usable_range: float = 20.0,
) -> GridMap:
    """Cast all beams (log odds; Thrun, Burgard and Fox, Probabilistic Robotics, section 9.2).

    Args:
        ranges: n by rays [m]; NaN says nothing.
        angles: Of the rays [rad].
        max_range: Ranges from here on met nothing [m]; as they may be failures, too, they free nothing.
        poses: Of the laser, n by (x [m], y [m], theta [rad]).
        resolution: Side of a cell [m]; made larger for a building that would fill the memory.
        usable_range: Beams are followed so far [m].
    """
    r = ranges.astype(np.float64)
    seen = (r > 0.05) & (r < max_range)
    reach = np.where(seen, np.minimum(r, usable_range), 0.0)
    x = poses[:, 0:1] + reach * np.cos(poses[:, 2:3] + angles)
    y = poses[:, 1:2] + reach * np.sin(poses[:, 2:3] + angles)
    low = np.array([x.min(), y.min()]) - 1.0
    size = np.array([x.max(), y.max()]) + 1.0 - low
    resolution = max(resolution, float(np.sqrt(size[0] * size[1] / _MAX_CELLS)))
    columns, rows = np.ceil(size / resolution).astype(int).tolist()
    odds = np.zeros((rows, columns), np.float32)
    _cast(odds, poses, x, y, seen, r <= usable_range, low[0], low[1], resolution, HIT, MISS, _LIMIT)
    cells = np.rint(100 / (1 + np.exp(-odds))).astype(np.int8)
    cells[odds == 0] = UNKNOWN
    return GridMap(np.clip(cells, UNKNOWN, OCCUPIED), resolution, (float(low[0]), float(low[1]), 0.0))


@compiled
def _cast(
    odds: NDArray[np.float32],
    poses: Floats,
    x: Floats,
    y: Floats,
    seen: NDArray[np.bool_],
    ended: NDArray[np.bool_],
    x0: float,
    y0: float,
    cell: float,
    hit: float,
    miss: float,
    limit: float,
) -> None:
    for i in range(x.shape[0]):
        u, v = (poses[i, 0] - x0) / cell, (poses[i, 1] - y0) / cell
        for j in range(x.shape[1]):
            if not seen[i, j]:
                continue
            du, dv = (x[i, j] - x0) / cell - u, (y[i, j] - y0) / cell - v
            # Half a cell at a time, and not the last cell, where a wall may be.
            length = np.hypot(du, dv)
            steps = int(2 * max(length - 1, 0.0))
            last_c, last_r = -1, -1
            for k in range(steps):
                c, r = int(u + du * (0.5 * k / length)), int(v + dv * (0.5 * k / length))
                if c != last_c or r != last_r:
                    odds[r, c] = max(odds[r, c] + miss, -limit)
                    last_c, last_r = c, r
            if ended[i, j]:
                c, r = int(u + du), int(v + dv)
                odds[r, c] = min(odds[r, c] + hit, limit)
