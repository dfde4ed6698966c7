"""What ``skytether lab bench face`` calls, by the entry point ``face`` of ``skytether.benches``."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from typing import NamedTuple

from .camera_image import decode
from .face_tracker import FaceTracker


class Seen(NamedTuple):
    """What one picture showed.

    Attributes:
        faces: So many.
        angle: To where the largest points off the camera's axis reversed, positive to the picture's right [rad]; NaN
            without one.
        bearing: Where it is off the axis, likewise [rad].
        size: Its longer side [pixels].
        cpu_ms: What the picture took, decoding included: processor time of this thread.
        wall_ms: The same by the clock.
    """

    faces: int
    angle: float
    bearing: float
    size: float
    cpu_ms: float
    wall_ms: float


def track_faces(pictures: Iterable[bytes], field_of_view: float) -> list[Seen]:
    """Follow the faces of one camera.

    Args:
        pictures: As files, in the order in which they were taken.
        field_of_view: Of the camera, from left to right [rad].
    """
    tracker, found = FaceTracker(field_of_view), []
    for picture in pictures:
        wall, cpu = time.perf_counter(), time.thread_time()
        faces = tracker.step(decode(picture))
        took = (time.thread_time() - cpu) * 1e3, (time.perf_counter() - wall) * 1e3
        first = (faces[0].angle, faces[0].bearing, faces[0].size) if faces else (math.nan,) * 3
        found.append(Seen(len(faces), *first, *took))
    return found
