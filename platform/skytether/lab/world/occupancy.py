"""The map of a plan, as map_server reads it: a YAML file and a picture in PGM.

Written by the lab itself, which knows the truth: what navigation makes of it can be compared with it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from skytether.messages import Header, MapMetaData, OccupancyGrid, Point, Time
from skytether.messages import Pose as PoseMessage

from .plan import Plan

FREE, UNKNOWN, OCCUPIED = 254, 205, 0
"""Grey levels of map_server's own maps."""
MARGIN = 0.5
"""Of unknown cells around what stands there, m."""


class Occupancy:
    """Cells of a plan.

    Attributes:
        resolution: [m] per cell.
        origin: Lower left corner of the lower left cell [m].
        grey: Shape (rows, columns), `FREE`, `UNKNOWN` or `OCCUPIED`; row 0 is the lowest (a PGM's is the highest).
    """

    def __init__(self, plan: Plan, resolution: float = 0.05) -> None:
        """Draw what is mapped; raises ValueError for a resolution that is not greater than 0."""
        if not resolution > 0:
            raise ValueError(f"the resolution must be greater than 0 m, not {resolution}")
        x_min, y_min, x_max, y_max = plan.bounds()
        self.resolution = resolution
        # On whole cells, so that walls fall alike in maps of one building.
        left, low = (int(np.floor((v - MARGIN) / resolution)) for v in (x_min, y_min))
        right, high = (int(np.ceil((v + MARGIN) / resolution)) for v in (x_max, y_max))
        self.origin = (left * resolution, low * resolution)
        columns, rows = right - left, high - low
        x = self.origin[0] + (np.arange(columns) + 0.5) * resolution
        y = self.origin[1] + (np.arange(rows) + 0.5) * resolution
        middles = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        solid = plan.clearance(middles, mapped_only=True) <= 0.0
        inside = (middles >= (x_min, y_min)).all(axis=1) & (middles <= (x_max, y_max)).all(axis=1)
        grey = np.where(solid, OCCUPIED, np.where(inside, FREE, UNKNOWN)).astype(np.uint8)
        self.grey: NDArray[np.uint8] = grey.reshape(rows, columns)

    def message(self, stamp: Time = Time()) -> OccupancyGrid:  # noqa: B008 - frozen
        """As ``/map`` has it."""
        rows, columns = self.grey.shape
        info = MapMetaData(stamp, self.resolution, columns, rows, PoseMessage(Point(*self.origin)))
        value = np.select([self.grey == OCCUPIED, self.grey == FREE], [100, 0], -1).astype(np.int8)
        return OccupancyGrid(Header(stamp, "map"), info, value.ravel())

    def save(self, file: Path) -> tuple[Path, Path]:
        """Write ``NAME.yaml`` and ``NAME.pgm`` beside it.

        Args:
            file: With or without a suffix.

        Returns:
            Both paths, the YAML file first.

        Raises:
            OSError: They cannot be written.
        """
        text, picture = file.with_suffix(".yaml"), file.with_suffix(".pgm")
        rows, columns = self.grey.shape
        picture.write_bytes(f"P5\n{columns} {rows}\n255\n".encode() + self.grey[::-1].tobytes())
        document = {
            "image": picture.name,
            "mode": "trinary",
            "resolution": self.resolution,
            "origin": [round(float(v), 9) for v in self.origin] + [0.0],
            "negate": 0,
            "occupied_thresh": 0.65,
            "free_thresh": 0.196,
        }
        text.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")
        return text, picture
