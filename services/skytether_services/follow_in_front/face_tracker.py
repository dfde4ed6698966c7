"""All faces in sight of one camera, from picture to picture.

A known face is detected anew in a square about where it was, in which it is large: a robot that turns moves it by more
than half of itself from one picture to the next. Others are looked for in all of the picture, part by part.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from PIL import Image

from .camera_image import Picture
from .face_detector import Box, FaceDetector, overlap
from .face_landmarks import FaceMesh, Landmarks
from .head_pose import turned

_LEAST_SCORE = 0.5
_STILL = 0.05
"""A face that is not detected any more is looked at where it was; it is there if it moved by less than this, in its own
sides. The network is sure of a face of which it sees half, and wrong about where that one points."""
_MOVED_DETECTED = 0.35
"""Landmarks further than this from where a face was detected are of none."""
_AROUND = 4.0
"""A known face is detected in a square of so many times its side."""
_SMALLEST = 24.0
"""Of a face's side, pixels: the angle of a smaller one is a guess."""
_SEARCH_EVERY = 5
"""While a face is known, others are looked for in each so many pictures only."""
_MOST = 3
"""Faces at the same time; more are not followed, but two are too many already."""
_LOOKED_AT = 2 * _MOST
"""Boxes of a picture at which is looked anew, the surest first: a wall of portraits must not take all the time."""
_SAME = 0.25
"""Overlap from which two boxes are one face."""


class Face(NamedTuple):
    """What a picture shows of one.

    Attributes:
        angle: To where it points off the camera's axis reversed, positive to the right of the picture [rad].
        bearing: Where it is, off the camera's axis, positive to the right of the picture [rad].
        size: Longer side [pixels].
        score: How sure, 0 to 1.
    """

    angle: float
    bearing: float
    size: float
    score: float


class _Known(NamedTuple):
    """A face of the last picture: its landmarks, and the box of the detector, which is another; None: it was not."""

    landmarks: Landmarks
    detected: Box | None

    @property
    def box(self) -> Box:
        """Around the landmarks."""
        return self.landmarks.box()


class FaceTracker:
    """Follows the faces of one camera.

    Args:
        field_of_view: Of the camera, from the left to the right of its picture [rad].
    """

    def __init__(self, field_of_view: float) -> None:
        if not 0 < field_of_view < math.pi:
            raise ValueError(f"a camera's field of view is above 0 and below pi, not {field_of_view} rad")
        self._half = math.tan(field_of_view / 2)
        self._detector, self._mesh = FaceDetector(), FaceMesh()
        self._known: list[_Known] = []
        self._size = (0, 0)
        self._pictures = 0

    def step(self, picture: Picture) -> list[Face]:
        """Faces of the next picture, the largest first."""
        image = Image.fromarray(picture)
        if image.size != self._size:  # another camera, or another mode of it: nothing is where it was
            self._known, self._size = [], image.size
        found: list[_Known] = []
        for known in self._known:
            _add(found, self._follow(image, known))
        if not found or self._pictures % _SEARCH_EVERY == 0:
            self._search(image, found)
        self._pictures += 1
        found.sort(key=lambda one: -one.box.height)
        self._known = found
        return [self._face(one.landmarks, image.size) for one in found]

    def _search(self, image: Image.Image, found: list[_Known]) -> None:
        """Look for faces that are not among those found, and add them."""
        left = _LOOKED_AT
        for part in self._parts(image, everywhere=not found):
            for box in self._detector.find(image, part):
                if left and len(found) < _MOST and not any(_same(box, one.box) for one in found):
                    left -= 1
                    _add(found, self._detect_twice(image, box))
            if found:
                break

    def _follow(self, image: Image.Image, known: _Known) -> _Known | None:
        """A face of the last picture; None: it is not there any more."""
        box = known.box
        side = round(_AROUND * max(box.width, box.height))
        left, top = round(box.x) - side // 2, round(box.y) - side // 2
        part = (max(left, 0), max(top, 0), min(left + side, image.width), min(top + side, image.height))
        if part[0] >= part[2] or part[1] >= part[3]:
            return None
        near = min(self._detector.find(image, part), key=lambda one: _moved(one, box), default=None)
        if near is None:
            found = self._detect(image, box)
            return _Known(found, None) if found is not None and _moved(found.box(), box) <= _STILL else None
        before = known.detected
        if before is not None:
            expected = box._replace(x=box.x + near.x - before.x, y=box.y + near.y - before.y)
            found = self._detect(image, expected)
            if found is not None and _moved(found.box(), expected) <= _STILL:
                return _Known(found, near)
        return self._detect_twice(image, near)

    def _detect_twice(self, image: Image.Image, box: Box) -> _Known | None:
        """A face that was detected in a box: boxes of a detector are not those of the landmarks."""
        first = self._detect(image, box)
        found = self._detect(image, first.box()) if first is not None else None
        return _Known(found, box) if found is not None and _moved(found.box(), box) <= _MOVED_DETECTED else None

    def _detect(self, image: Image.Image, box: Box) -> Landmarks | None:
        found = self._mesh.detect(image, box)
        now = found.box()
        return found if found.score >= _LEAST_SCORE and max(now.width, now.height) >= _SMALLEST else None

    def _parts(self, image: Image.Image, *, everywhere: bool) -> list[tuple[int, int, int, int] | None]:
        """What to look at: all of it, and one of the parts in turn, in which small faces are larger."""
        width, height = image.size
        side = min(width, height) * 5 // 8
        lefts = np.linspace(0, width - side, 3).astype(int).tolist()
        tops = np.linspace(0, height - side, 2).astype(int).tolist()
        parts = [(left, top, left + side, top + side) for left in lefts for top in tops]
        turn = self._pictures // (1 if everywhere else _SEARCH_EVERY)
        if everywhere:
            return [None, parts[turn % len(parts)], parts[(turn + 3) % len(parts)]]
        return [(None, *parts)[turn % (1 + len(parts))]]

    def _face(self, found: Landmarks, size: tuple[int, int]) -> Face:
        width, _ = size
        box = found.box()
        bearing = math.atan((2 * box.x / width - 1) * self._half)
        return Face(turned(found.points) - bearing, bearing, max(box.width, box.height), found.score)


def _add(found: list[_Known], new: _Known | None) -> None:
    if new is not None and len(found) < _MOST and not any(_same(new.box, one.box) for one in found):
        found.append(new)


def _moved(now: Box, before: Box) -> float:
    """From one middle to the other, in sides of the face."""
    return math.hypot(now.x - before.x, now.y - before.y) / max(now.width, now.height, 1.0)


def _same(one: Box, other: Box) -> bool:
    places = np.array([[[b.x, b.y], [b.width, b.height]] for b in (one, other)])
    return bool(overlap(places[0], places[1:])[0] > _SAME)
