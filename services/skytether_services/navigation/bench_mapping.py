"""What ``skytether lab bench mapping`` calls, by the entry point ``mapping`` of ``skytether.benches``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .grid_map import GridMap, draw_map, save_map, save_png
from .log_odds import occupancy
from .mapping import find_trajectory

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Built:
    """A trajectory, and the scans to draw a map from.

    Attributes:
        poses: Of the laser at each scan, n by (x [m], y [m], theta [rad]).
        ranges: n by rays [m].
        angles: Of the rays [rad].
        max_range: Ranges from here on met nothing [m].
    """

    poses: Floats
    ranges: NDArray[np.float32]
    angles: Floats
    max_range: float

    def grid(self) -> GridMap:
        """The occupancy map."""
        return occupancy(self.ranges, self.angles, self.max_range, self.poses)

    def save(self, path: Path) -> list[Path]:
        """Write it as YAML and PGM of map_server, and as PNG beside them."""
        grid = self.grid()
        yaml, png = path.with_suffix(".yaml"), path.with_suffix(".png")
        image = save_map(yaml, grid)
        save_png(png, draw_map(grid, scale=1))
        return [yaml, image, png]


def build(
    *,
    stamps: Floats,
    ranges: NDArray[np.float32],
    angles: Floats,
    max_range: float,
    odometry: Floats | None,
    progress: Callable[[str], None],
) -> Built:
    """Build a map of a recording; see `skytether_services.navigation.mapping.find_trajectory`."""
    found = find_trajectory(stamps, ranges, angles, max_range, odometry, progress=progress)
    return Built(found.poses, ranges, angles, max_range)
