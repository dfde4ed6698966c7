"""Whose face it is: the operator's is where the operator's legs are. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum

from .face_tracker import Face

_BESIDE = math.radians(14)
"""A face is this near to the direction of its legs: 0.2 m at 0.8 m, as far as one leans."""
_NEXT = math.radians(25)
"""A second face that is not further from it than this may be theirs as well: legs are seen less exactly when one
hides the other."""
_BEHIND = 0.7
"""Unless it is smaller by this: it is behind."""


class FaceChoice(StrEnum):
    """Whether the operator's face is known.

    Attributes:
        SEEN: It is.
        NONE: No face is where the operator is.
        SEVERAL: More than one could be the operator's.
    """

    SEEN = "seen"
    NONE = "none"
    SEVERAL = "several"


def choose(faces: Sequence[Face], legs: float | None) -> tuple[Face | None, FaceChoice]:
    """The operator's face among all.

    Args:
        faces: Of one picture; ``bearing`` is positive where a robot's left is, for the camera looks back.
        legs: Where the operator's legs are off straight back, positive to the robot's left [rad]; None: not known.
    """
    if legs is None:
        return (faces[0], FaceChoice.SEEN) if len(faces) == 1 else (None, _none(faces))
    near = [face for face in faces if abs(face.bearing - legs) <= _NEXT]
    near.sort(key=lambda face: -face.size)
    if len(near) > 1 and near[1].size > _BEHIND * near[0].size:
        return None, FaceChoice.SEVERAL
    if not near or abs(near[0].bearing - legs) > _BESIDE:
        return None, FaceChoice.NONE
    return near[0], FaceChoice.SEEN


def _none(faces: Sequence[Face]) -> FaceChoice:
    return FaceChoice.SEVERAL if faces else FaceChoice.NONE
