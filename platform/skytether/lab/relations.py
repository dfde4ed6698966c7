"""How good a trajectory is, by the official relations (Kümmerle et al. 2009)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .carmen import CarmenError, Relations

Floats = NDArray[np.float64]

TOLERANCE_S = 1.0
"""From a relation's stamp to the nearest scan; beyond it the relation is of another part of the log."""
NEIGHBOUR_S = 10.0
"""Up to here apart, two scans are neighbours; otherwise the relation closes a loop."""


@dataclass(frozen=True, slots=True)
class Errors:
    """Mean and standard deviation of the errors of a set of relations; NaN for an empty one.

    Attributes:
        relations: How many there are.
    """

    translation_mean_m: float
    translation_std_m: float
    rotation_mean_deg: float
    rotation_std_deg: float
    relations: int


@dataclass(frozen=True, slots=True)
class Score:
    """Errors of all relations, and apart: between neighbours and over loops."""

    all: Errors
    neighbours: Errors
    loops: Errors


def relative(a: Floats, b: Floats) -> Floats:
    """Poses b seen from poses a, n by (x, y, theta); theta in [-pi, pi)."""
    cos, sin = np.cos(a[:, 2]), np.sin(a[:, 2])
    dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    turn = (b[:, 2] - a[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return np.stack([cos * dx + sin * dy, -sin * dx + cos * dy, turn], axis=1)


def compose(a: Floats, b: Floats) -> Floats:
    """Poses b, seen from poses a, in the frame of a; n by (x, y, theta)."""
    cos, sin = np.cos(a[:, 2]), np.sin(a[:, 2])
    x = a[:, 0] + cos * b[:, 0] - sin * b[:, 1]
    y = a[:, 1] + sin * b[:, 0] + cos * b[:, 1]
    return np.stack([x, y, (a[:, 2] + b[:, 2] + np.pi) % (2 * np.pi) - np.pi], axis=1)


def inverse(a: Floats) -> Floats:
    """The origin seen from poses a."""
    return relative(a, np.zeros_like(a))


def nearest(stamps: Floats, wanted: Floats) -> NDArray[np.int64]:
    """Index of the stamp nearest to each wanted one; stamps rise."""
    right = np.clip(np.searchsorted(stamps, wanted), 1, max(len(stamps) - 1, 1))
    right = np.minimum(right, len(stamps) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(wanted - stamps[left] <= stamps[right] - wanted, left, right).astype(np.int64)


def score(stamps: Floats, poses: Floats, relations: Relations, offset: float = 0.0) -> Score:
    """Errors e = inverse(p1) p2 inverse(expected) over the relations.

    Args:
        stamps: Of the poses [s], never falling.
        poses: n by (x [m], y [m], theta [rad]).
        relations: The true motions.
        offset: What is added to the relations' stamps to have the poses' [s]; -1211.44 for building 079.

    Raises:
        CarmenError: No relation is of this time.
    """
    wanted = relations.stamps + offset
    first, second = nearest(stamps, wanted[:, 0]), nearest(stamps, wanted[:, 1])
    near = np.abs(stamps[first] - wanted[:, 0]) <= TOLERANCE_S
    near &= np.abs(stamps[second] - wanted[:, 1]) <= TOLERANCE_S
    if not near.any():
        ours, theirs = (f"{s.min():.1f} to {s.max():.1f} s" for s in (stamps, wanted))
        raise CarmenError(
            f"no relation is of this log: it is from {ours}, they with the offset {theirs}; give another stamp offset"
        )
    first, second = first[near], second[near]
    found = relative(poses[first], poses[second])
    error = compose(found, inverse(relations.motions[near]))
    translation, rotation = np.hypot(error[:, 0], error[:, 1]), np.degrees(np.abs(error[:, 2]))
    neighbours = np.abs(wanted[near, 1] - wanted[near, 0]) <= NEIGHBOUR_S

    def of(chosen: NDArray[np.bool_]) -> Errors:
        if not chosen.any():
            return Errors(float("nan"), float("nan"), float("nan"), float("nan"), 0)
        t, r = translation[chosen], rotation[chosen]
        return Errors(float(t.mean()), float(t.std()), float(r.mean()), float(r.std()), int(chosen.sum()))

    return Score(of(np.ones_like(neighbours)), of(neighbours), of(~neighbours))
