"""468 points of one face: MediaPipe's face mesh (Kartynnik et al. 2019), and the face's angle from them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from .face_detector import Box, load_network, sureness

Floats = NDArray[np.float64]

_SIDE = 192
_ROOM = 1.5
"""What the network sees is a square of so many times the longer side of the face."""
_EYES = (33, 263)
"""Outer corners of the person's right and left eye."""


class Landmarks(NamedTuple):
    """Points of a face.

    Attributes:
        points: 468 by (x, y, z): x to the right and y downwards in the picture, z away from the camera [pixels].
        score: How sure that it is a face, 0 to 1.
    """

    points: Floats
    score: float

    def box(self) -> Box:
        """Around all points, along the line of the eyes."""
        right, left = self.points[_EYES[0], :2], self.points[_EYES[1], :2]
        tilt = math.atan2(left[1] - right[1], left[0] - right[0])
        turn = np.array([[math.cos(tilt), -math.sin(tilt)], [math.sin(tilt), math.cos(tilt)]])
        along = self.points[:, :2] @ turn
        low, high = along.min(axis=0), along.max(axis=0)
        x, y = (turn @ ((low + high) / 2)).tolist()
        width, height = (high - low).tolist()
        return Box(x, y, width, height, tilt, self.score)


class FaceMesh:
    """Finds the points of a face whose place is known roughly."""

    def __init__(self) -> None:
        self._network = load_network("face_landmark.tflite")
        self._input = self._network.get_input_details()[0]["index"]
        self._points, self._score = (output["index"] for output in self._network.get_output_details())

    def detect(self, image: Image.Image, box: Box) -> Landmarks:
        """Points of the face in a box of an RGB picture."""
        scale = _ROOM * max(box.width, box.height) / _SIDE
        along, across = scale * math.cos(box.tilt), scale * math.sin(box.tilt)
        middle = _SIDE / 2
        x0 = box.x - along * middle + across * middle
        y0 = box.y - across * middle - along * middle
        seen = image.transform(
            (_SIDE, _SIDE),
            Image.Transform.AFFINE,
            (along, -across, x0, across, along, y0),
            Image.Resampling.BILINEAR,
        )
        self._network.set_tensor(self._input, (np.asarray(seen, np.float32) / 255)[None])
        self._network.invoke()
        points = self._network.get_tensor(self._points).reshape(-1, 3).astype(np.float64)
        score = float(sureness(self._network.get_tensor(self._score)).ravel()[0])
        place = np.empty_like(points)
        place[:, 0] = x0 + along * points[:, 0] - across * points[:, 1]
        place[:, 1] = y0 + across * points[:, 0] + along * points[:, 1]
        place[:, 2] = scale * points[:, 2]
        return Landmarks(place, score)
