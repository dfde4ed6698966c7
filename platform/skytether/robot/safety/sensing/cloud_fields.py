"""Coordinates out of a sensor_msgs/PointCloud2, without trusting a word of what it says about itself. Pure.

A cloud says how many points it has, how far they lie apart in its bytes and where in each point its coordinates are.
All that is checked against the bytes that are there before any of them is read.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from skytether.messages import PointCloud2, PointField

MAX_POINTS = 500_000
"""Of one cloud: 848 by 480 fit. More would cost the loop its time."""
FARTHEST_M = 1000.0
"""No sensor of a robot measures so far."""
_SMALLEST_M = 1e-3
_ABSURD_SHARE = 0.1
_NUMBERS = {7: "f4", 8: "f8"}
"""Datatypes of coordinates: FLOAT32 and FLOAT64."""
_MAX_FIELDS = 64
"""More are no cloud of this world."""

Floats = NDArray[np.float32]
Line = NDArray[np.floating]
"""One coordinate of some points, where it lies in the cloud's bytes."""


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Of all points, in the axes of their frame [m]: views of the cloud's bytes, which are not read yet."""

    x: NDArray[np.floating]
    """Shape (height, width), as the other two."""
    y: NDArray[np.floating]
    z: NDArray[np.floating]

    def sample(self, rows: int, columns: int) -> tuple[Line, Line, Line]:
        """Every so many rows and columns, in one line each."""
        planes = (self.x[::rows, ::columns], self.y[::rows, ::columns], self.z[::rows, ::columns])
        x, y, z = (plane.reshape(-1) for plane in planes)
        return x, y, z

    def blocks(self, most: int) -> Iterator[tuple[Line, Line, Line]]:
        """All of them, so many at a time at most: what fits into a processor's cache is read many times as fast."""
        height, width = self.x.shape
        step, row = self.x.strides[1], self.x.strides[0]
        lines, points = (1, height * width) if row == width * step else (height, width)
        x, y, z = (as_strided(plane, (lines, points), (row, step)) for plane in (self.x, self.y, self.z))
        for line in range(lines):
            for first in range(0, points, most):
                part = (line, slice(first, first + most))
                yield x[part], y[part], z[part]


def absurd(x: Line, y: Line, z: Line) -> bool:
    """Whether these are bytes that were meant to be something else: numbers, but of no size that anything has."""
    largest = np.maximum(np.maximum(np.abs(x), np.abs(y)), np.abs(z))
    some = largest[np.isfinite(largest) & (largest > 0)]
    return bool(np.count_nonzero((some < _SMALLEST_M) | (some > FARTHEST_M)) > _ABSURD_SHARE * len(some))


def coordinates(cloud: PointCloud2) -> Coordinates | str:
    """What a cloud holds, or what is wrong with it. Never raises.

    A cloud of no points is not wrong. Numbers may be infinite or NaN, whatever ``is_dense`` says.
    """
    height, width, step, row = cloud.height, cloud.width, cloud.point_step, cloud.row_step
    if not height * width:
        nothing = np.empty((0, 0), dtype=np.float32)
        return Coordinates(nothing, nothing, nothing)
    if height * width > MAX_POINTS:
        return f"{width} by {height} points, {MAX_POINTS} at most"
    if row < width * step:
        return f"row_step {row} is less than {width} points of {step} bytes (point_step)"
    needed = (height - 1) * row + width * step
    if cloud.data.size < needed:
        return f"{width} by {height} points need {needed} bytes, and there are {cloud.data.size}"
    found = []
    for name in "xyz":
        field = _field(cloud, name)
        if isinstance(field, str):
            return field
        kind = np.dtype((">" if cloud.is_bigendian else "<") + _NUMBERS[field.datatype])
        if field.offset + kind.itemsize > step:
            return f"field {name} at byte {field.offset} is not within the {step} bytes of a point (point_step)"
        view: NDArray[np.floating] = np.ndarray(
            (height, width), kind, buffer=cloud.data.data, offset=field.offset, strides=(row, step)
        )
        found.append(view)
    return Coordinates(*found)


def _field(cloud: PointCloud2, name: str) -> PointField | str:
    if len(cloud.fields) > _MAX_FIELDS:
        return f"{len(cloud.fields)} fields"
    named = [field for field in cloud.fields if field.name == name]
    if len(named) != 1:
        return f"{len(named)} fields of the name {name}, one is needed"
    field = named[0]
    if field.datatype not in _NUMBERS or field.count not in (0, 1):
        return f"field {name} must be one FLOAT32 (7) or FLOAT64 (8), not {field.count} of datatype {field.datatype}"
    return field
