"""How well the eyes of following in front see where a face points: on rendered faces, whose angle is known."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, Protocol

import numpy as np

from skytether.lab.trail import Pose
from skytether.lab.world.camera import FaceStudio
from skytether.lab.world.robot import RearParams

from .navigation import load

NOTE = "rendered faces of one person, evenly lit: photographs are harder"
_STEP = math.radians(1.0)
"""Between neighbouring pictures of a head that turns."""
_ASIDE = math.radians(8.0)
"""The operator stands off the camera's axis by up to this, and goes from side to side."""
_PERIOD = 90
"""Pictures of one way from side to side and back."""


class Seen(Protocol):
    """What the entry point says of a picture."""

    @property
    def faces(self) -> int:
        """So many."""
        ...

    @property
    def angle(self) -> float:
        """Of the largest, off the robot's heading; NaN without one [rad]."""
        ...

    @property
    def size(self) -> float:
        """Of it [pixels]."""
        ...

    @property
    def cpu_ms(self) -> float:
        """Processor time."""
        ...

    @property
    def wall_ms(self) -> float:
        """By the clock."""
        ...


class FaceBench(Protocol):
    """The entry point ``face``."""

    def __call__(self, pictures: Iterable[bytes], field_of_view: float) -> Sequence[Seen]:
        """Follow the face through pictures."""
        ...


def bench_face(distances: Sequence[float], most: float, seeds: Sequence[int]) -> dict[str, Any]:
    """Let a head turn from side to side in front of the camera.

    Args:
        distances: Of the operator from the camera [m].
        most: How far it turns [rad].
        seeds: Of where the robot stands, and of the sensor's noise; a run for each.

    Raises:
        skytether.lab.world.model.WorldError: Nothing can be rendered here; the text says what to install.
        NavigationBenchError: The service is not there.
    """
    look: FaceBench = load("face", "follow-in-front")
    rows, errors, seen = [], [], []
    for distance in distances:
        off: list[float] = []
        here: list[Seen] = []
        size = 0
        for seed in seeds:
            yaws, pictures = _pictures(distance, most, seed)
            found = look(pictures, RearParams().camera_field)
            off += [math.degrees(one.angle - yaw) for one, yaw in zip(found, yaws, strict=True)]
            here += found
            size += sum(map(len, pictures))
        rows.append({"distance_m": distance, "picture_kb": round(size / len(here) / 1e3, 1), **row_of(off, here)})
        errors += off
        seen += here
    return {"faces": NOTE, "most_deg": round(math.degrees(most), 1), **row_of(errors, seen), "distances": rows}


def _pictures(distance: float, most: float, seed: int) -> tuple[list[float], list[bytes]]:
    random = np.random.default_rng(seed)
    x, y, heading = random.uniform((-1.0, -1.0, -math.pi), (1.0, 1.0, math.pi)).tolist()
    side = np.arange(0, most + 1e-9, _STEP)
    yaws = np.concatenate([side, side[::-1], -side, -side[::-1]]).tolist()
    with FaceStudio(seed) as studio:
        pictures = [
            studio.sensor.jpeg(
                studio.draw(
                    yaw,
                    distance,
                    aside=_ASIDE * math.sin(math.tau * (number / _PERIOD + seed / 10)),
                    robot=Pose(x, y, heading),
                )
            )
            for number, yaw in enumerate(yaws)
        ]
    return yaws, pictures


def row_of(off: Sequence[float], seen: Sequence[Seen]) -> dict[str, Any]:
    """Of one distance: by how much each face was taken to be turned [deg; NaN: none was found], and how looks went."""
    known = np.array([value for value in off if not math.isnan(value)])
    cpu, wall = (np.array([getattr(one, name) for one in seen]) for name in ("cpu_ms", "wall_ms"))
    return {
        "pictures": len(seen),
        "detected_percent": round(100 * sum(one.faces > 0 for one in seen) / len(seen), 2),
        "two_seen": sum(one.faces > 1 for one in seen),
        "yaw_error_mean_deg": round(float(np.abs(known).mean()), 2) if known.size else None,
        "yaw_error_p95_deg": round(float(np.quantile(np.abs(known), 0.95)), 2) if known.size else None,
        "yaw_error_worst_deg": round(float(np.abs(known).max()), 2) if known.size else None,
        "yaw_bias_deg": round(float(known.mean()), 2) if known.size else None,
        "face_pixels": round(float(np.nanmean([one.size for one in seen])), 1) if known.size else None,
        "cpu_ms_mean": round(float(cpu.mean()), 2),
        "cpu_ms_p99": round(float(np.quantile(cpu, 0.99)), 2),
        "wall_ms_mean": round(float(wall.mean()), 2),
        "wall_ms_worst": round(float(wall.max()), 2),
    }
