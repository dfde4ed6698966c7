"""Whose face it is: the operator's is where the operator's legs are. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum

from .face_tracker import Face
from .operator import OVER_LEGS

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
        if len(faces) == 1:
            return faces[0], FaceChoice.SEEN
        return None, FaceChoice.SEVERAL if faces else FaceChoice.NONE
    near = [face for face in faces if abs(face.bearing - legs) <= _NEXT]
    near.sort(key=lambda face: -face.size)
    if len(near) > 1 and near[1].size > _BEHIND * near[0].size:
        return None, FaceChoice.SEVERAL
    if not near or abs(near[0].bearing - legs) > OVER_LEGS:
        return None, FaceChoice.NONE
    return near[0], FaceChoice.SEEN
