"""Where faces are in a picture: BlazeFace, short range (Bazarevsky et al. 2019), as MediaPipe ships it.

The network sees 128 x 128 pixels, and misses faces smaller than a tenth of them. So a picture is looked at as a whole,
and in parts.
"""

from __future__ import annotations

from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

Floats = NDArray[np.float32]

_SIDE = 128
_GRIDS = ((16, 2), (8, 6))
"""The network answers for two boxes in each of 16 x 16 places, and for six in each of 8 x 8."""
_LEAST_SCORE = 0.5
_SAME = 0.3
"""Boxes that overlap by more than this (intersection over union) are of one face."""
_STEEPEST = 80.0
"""Of a network's answer before the logistic function; more overflows."""


class Box(NamedTuple):
    """A face in a picture, in pixels: the middle, both sides, the tilt to the right [rad], and how sure (0 to 1)."""

    x: float
    y: float
    width: float
    height: float
    tilt: float
    score: float


def load_network(name: str) -> Any:
    """An interpreter of a model of the folder ``models``, with one thread."""
    from ai_edge_litert.interpreter import Interpreter

    model = files(__package__) / "models" / name
    network = Interpreter(model_content=model.read_bytes(), num_threads=1)
    network.allocate_tensors()
    return network


def sureness(answers: Floats) -> NDArray[np.floating]:
    """Of a network's answers to "is it a face", 0 to 1."""
    sure: NDArray[np.floating] = 1 / (1 + np.exp(-np.clip(answers, -_STEEPEST, _STEEPEST)))
    return sure


class FaceDetector:
    """Finds the faces of one picture; keeps nothing from one to the next."""

    def __init__(self) -> None:
        self._network = load_network("face_detection_short_range.tflite")
        self._input = self._network.get_input_details()[0]["index"]
        self._outputs = [output["index"] for output in self._network.get_output_details()]
        self._anchors = np.concatenate([_grid(*grid) for grid in _GRIDS])

    def find(self, image: Image.Image, part: tuple[int, int, int, int] | None = None) -> list[Box]:
        """Faces, the surest first.

        Args:
            image: RGB.
            part: Left, top, right, bottom of what is looked at [pixels]; None: all.
        """
        left, top, right, bottom = part or (0, 0, *image.size)
        side = max(right - left, bottom - top)
        scale = _SIDE / side
        small = image.resize(
            (max(1, round((right - left) * scale)), max(1, round((bottom - top) * scale))),
            Image.Resampling.BILINEAR,
            box=(left, top, right, bottom),
        )
        seen = np.zeros((_SIDE, _SIDE, 3), np.float32)
        seen[: small.height, : small.width] = np.asarray(small, np.float32) / 127.5 - 1
        self._network.set_tensor(self._input, seen[None])
        self._network.invoke()
        boxes, scores = (self._network.get_tensor(output)[0] for output in self._outputs)
        scores = sureness(scores[:, 0])
        likely = scores >= _LEAST_SCORE
        values = boxes[likely].reshape(-1, 8, 2) / _SIDE
        values[:, 0] += self._anchors[likely]
        values[:, 2:] += self._anchors[likely][:, None]
        return [_box(value * side, score, left, top) for value, score in _merged(values, scores[likely])]


def _grid(side: int, boxes: int) -> Floats:
    """Middles of a grid of places, as shares of the picture, each as often as there are boxes for it."""
    y, x = np.mgrid[:side, :side].astype(np.float32)
    middles = (np.stack([x, y], axis=-1).reshape(-1, 2) + 0.5) / side
    return np.repeat(middles, boxes, axis=0)


def _merged(values: Floats, scores: NDArray[np.floating]) -> list[tuple[Floats, float]]:
    """One of each heap of boxes that overlap: their mean, weighted by their scores."""
    found: list[tuple[Floats, float]] = []
    left = np.argsort(-scores)
    while left.size:
        same = overlap(values[left[0], :2], values[left][:, :2]) > _SAME
        same[0] = True
        heap = left[same]
        found.append((np.average(values[heap], axis=0, weights=scores[heap]), float(scores[heap[0]])))
        left = left[~same]
    return found


def overlap(one: NDArray[np.floating], others: NDArray[np.floating]) -> NDArray[np.floating]:
    """Intersection over union of a box with others; each is ((x, y), (width, height))."""
    low = np.maximum(one[0] - one[1] / 2, others[:, 0] - others[:, 1] / 2)
    high = np.minimum(one[0] + one[1] / 2, others[:, 0] + others[:, 1] / 2)
    common = np.prod(np.maximum(high - low, 0), axis=1)
    union = np.prod(one[1]) + np.prod(others[:, 1], axis=1) - common
    share: NDArray[np.floating] = common / np.maximum(union, 1e-9)
    return share


def _box(value: Floats, score: float, left: float, top: float) -> Box:
    (x, y), (width, height), right_eye, left_eye = value[:4].tolist()
    # The person's right eye is on the left of the picture.
    tilt = np.arctan2(left_eye[1] - right_eye[1], left_eye[0] - right_eye[0])
    return Box(x + left, y + top, width, height, float(tilt), score)
