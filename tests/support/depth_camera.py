"""A played depth camera: what it sees of a floor and of boxes' front sides, and the clouds that say so."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skytether.messages import Header, PointCloud2, PointField, Time


class Face(NamedTuple):
    """The front of a box that stands across the way [m], in the base frame."""

    x: float
    left: tuple[float, float] = (-9.0, 9.0)
    up: tuple[float, float] = (0.0, 3.0)


@dataclass(frozen=True)
class Camera:
    """Where it is, and what it can: a RealSense in small.

    Attributes:
        far: What is farther away than this has no reading [m].
        near: The same, nearer.
        slope: Rise of the floor in front of it.
    """

    width: int = 160
    height: int = 120
    fov: float = math.radians(87)
    x: float = 0.25
    y: float = 0.0
    z: float = 0.4
    yaw: float = 0.0
    pitch: float = math.radians(15)
    roll: float = 0.0
    far: float = 8.0
    near: float = 0.0
    slope: float = 0.0

    def turn(self) -> np.ndarray:
        """From its body's axes to the base frame's, as URDF has it."""
        cr, sr, cp, sp = math.cos(self.roll), math.sin(self.roll), math.cos(self.pitch), math.sin(self.pitch)
        cy, sy = math.cos(self.yaw), math.sin(self.yaw)
        roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        return np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]) @ pitch @ roll

    def see(self, faces: Iterable[Face] = ()) -> np.ndarray:
        """Points in its body's axes (x forward), shape (height, width, 3); NaN where there is no reading."""
        focal = self.width / 2 / math.tan(self.fov / 2)
        u = (np.arange(self.width) - (self.width - 1) / 2) / focal
        v = (np.arange(self.height) - (self.height - 1) / 2) / focal
        body = np.stack(np.broadcast_arrays(1.0, -u[None, :], -v[:, None]), axis=-1)
        rays = body @ self.turn().T
        with np.errstate(all="ignore"):
            floor = -self.z / (rays[..., 2] - self.slope * rays[..., 0])
            depth = np.where(floor > 0, floor, np.inf)
            for face in faces:
                there = (face.x - self.x) / rays[..., 0]
                y, z = self.y + there * rays[..., 1], self.z + there * rays[..., 2]
                hit = (there > 0) & (y >= face.left[0]) & (y <= face.left[1]) & (z >= face.up[0]) & (z <= face.up[1])
                depth = np.where(hit & (there < depth), there, depth)
        depth = np.where((depth < self.far) & (depth >= self.near), depth, np.nan)
        return body * depth[..., None]


def optical(points: np.ndarray) -> np.ndarray:
    """Body's axes as REP 103 has them for cameras: z forward, x to the right."""
    return np.stack((-points[..., 1], -points[..., 2], points[..., 0]), axis=-1)


def cloud_of(
    points: np.ndarray,
    kind: str = "<f4",
    step: int = 16,
    offsets: tuple[int, int, int] | None = None,
    padding: int = 0,
    frame: str = "camera_link",
    stamp: Time | None = None,
) -> PointCloud2:
    """A cloud's message.

    Args:
        points: Shape (height, width, 3).
        kind: Of each number.
        step: Bytes of a point at least.
        offsets: Of x, y, z.
        padding: Bytes behind each row.
        frame: Its name.
        stamp: Of the message; None: it has none.
    """
    height, width, _ = points.shape
    size = np.dtype(kind).itemsize
    at = offsets or (0, size, 2 * size)
    step = max(step, max(at) + size)
    layout = np.dtype({"names": ["x", "y", "z"], "formats": [kind] * 3, "offsets": at, "itemsize": step})
    rows = np.full((height, width * step + padding), 0xA5, dtype=np.uint8)
    held = np.frombuffer(rows[:, : width * step].tobytes(), layout).copy().reshape(height, width)
    with np.errstate(over="ignore"):
        for i, name in enumerate("xyz"):
            held[name] = points[..., i]
    rows[:, : width * step] = np.frombuffer(held.tobytes(), np.uint8).reshape(height, width * step)
    datatype = 7 if size == 4 else 8
    return PointCloud2(
        header=Header(stamp=stamp or Time(), frame_id=frame),
        height=height,
        width=width,
        fields=[PointField(name, offset, datatype, 1) for name, offset in zip("xyz", at, strict=True)],
        is_bigendian=kind.startswith(">"),
        point_step=step,
        row_step=width * step + padding,
        data=rows.reshape(-1),
    )
