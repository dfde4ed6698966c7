"""Makes the face of the simulated operator out of a photograph: a mesh of its landmarks, textured with it.

``python -m skytether_services.follow_in_front.head_mesh astronaut.png FOLDER`` made ``head.obj`` and ``head.png`` in
``skytether/lab/world/assets``, of NASA's portrait of Eileen Collins (public domain) as scikit-image 0.26 ships it.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import Delaunay

from .face_detector import FaceDetector
from .face_landmarks import FaceMesh
from .head_pose import PAIRS

Floats = NDArray[np.float64]

_WIDTH = 0.14
"""Of a face between its sides, m."""
_SIDES = (234, 454)
_ROUND = ((1.18, 0.25), (1.42, 0.75), (1.5, 1.2))
"""Rings about the face for hair and ears: so many times as far out, and so much deeper, in half faces."""
_LOWEST = math.radians(12)
"""They end so far below the middle: there the photograph shows no head any more."""


def main(photograph: Path, folder: Path) -> None:
    """Write ``head.obj`` and ``head.png``."""
    image = Image.open(photograph).convert("RGB")
    mesh, box = FaceMesh(), FaceDetector().find(image)[0]
    for _ in range(5):  # settles
        found = mesh.detect(image, box)
        box = found.box()
    flat = _with_rings(found.points)
    low, high = flat[:, :2].min(axis=0), flat[:, :2].max(axis=0)
    left, top = np.maximum(low, 0).astype(int).tolist()
    right, bottom = np.minimum(high + 1, image.size).astype(int).tolist()
    image.crop((left, top, right, bottom)).save(folder / "head.png", optimize=True)
    shares = (flat[:, :2] - (left, top)) / (right - left, bottom - top)
    triangles = Delaunay(flat[:, :2]).simplices
    places = _in_the_head(flat)
    lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in places.tolist()]
    lines += [f"vt {u:.5f} {1 - v:.5f}" for u, v in np.clip(shares, 0, 1).tolist()]
    for corners in triangles + 1:
        a, b, c = corners.tolist()
        first, second, third = places[[a - 1, b - 1, c - 1]]
        if np.cross(second - first, third - first)[0] < 0:  # faces look forward
            b, c = c, b
        lines.append(f"f {a}/{a} {b}/{b} {c}/{c}")
    (folder / "head.obj").write_text("\n".join(lines) + "\n")


def _with_rings(points: Floats) -> Floats:
    """The landmarks, and around them hair and ears, which have none."""
    middle = points[list(_SIDES)].mean(axis=0)
    angles = np.arctan2(points[:, 1] - middle[1], points[:, 0] - middle[0])
    out = np.hypot(points[:, 0] - middle[0], points[:, 1] - middle[1])
    half = out[list(_SIDES)].mean()
    rings = [points]
    for far, deep in _ROUND:
        ring = []
        for angle in np.linspace(-math.pi - _LOWEST, _LOWEST, 28):
            near = np.abs(np.angle(np.exp(1j * (angles - angle)))) < math.radians(8)
            edge = float(out[near].max())
            ring.append(
                (
                    middle[0] + far * edge * math.cos(angle),
                    middle[1] + far * edge * math.sin(angle),
                    middle[2] + deep * half,
                )
            )
        rings.append(np.array(ring))
    return np.vstack(rings)


def _in_the_head(points: Floats) -> Floats:
    """From pixels to metres: x ahead, y to the person's left, z up; the middle is between the sides of the face."""
    pixels = float(np.linalg.norm(points[_SIDES[1]] - points[_SIDES[0]]))
    places = (points - points[list(_SIDES)].mean(axis=0)) * (_WIDTH / pixels)
    places = np.stack([-places[:, 2], places[:, 0], -places[:, 1]], axis=1)
    # The photograph's head may be turned and tilted a little: the mesh looks straight ahead.
    across = np.mean([places[b] - places[a] for a, b in PAIRS], axis=0)
    across /= np.linalg.norm(across)
    ahead = np.cross(across, (0.0, 0.0, 1.0))
    ahead /= np.linalg.norm(ahead)
    straight: Floats = places @ np.stack([ahead, across, np.cross(ahead, across)], axis=1)
    return straight


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
