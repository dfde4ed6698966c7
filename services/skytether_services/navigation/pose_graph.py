"""Poses from motions between them: least squares on a sparse graph, robust against loops that are wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from .poses import between, wrap

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Edges:
    """Motions between poses.

    Attributes:
        pairs: m by 2: numbers of the poses.
        motions: m by 3: the second pose seen from the first.
        information: m by 3 by 3, in the frame of the first pose.
        loops: m, bool: may be wrong, so that the robust kernel is for it.
    """

    pairs: NDArray[np.int64]
    motions: Floats
    information: Floats
    loops: NDArray[np.bool_]


def optimise(poses: Floats, edges: Edges, *, kernel: float = 3.0, iterations: int = 20) -> tuple[Floats, Floats]:
    """Gauss-Newton over all poses but the first, which stays.

    Args:
        poses: n by 3, to begin with.
        edges: Each pose hangs by them on the first one.
        kernel: Errors of loops beyond so many standard deviations count less and less (Cauchy).
        iterations: At most; it ends when nothing moves by 0.1 mm.

    Returns:
        The poses, and the errors of the edges in standard deviations (Mahalanobis).
    """
    poses = poses.copy()
    n = len(poses)
    first, second = edges.pairs[:, 0], edges.pairs[:, 1]
    rows, columns = _pattern(first, second)
    errors = _errors(poses, edges)
    for _ in range(iterations):
        squares = np.einsum("mi,mij,mj->m", errors, edges.information, errors)
        weights = np.where(edges.loops, 1 / (1 + squares / kernel**2), 1.0)
        a, b = _jacobians(poses[first], poses[second])
        information = edges.information * weights[:, None, None]
        ai, bi = np.swapaxes(a, 1, 2) @ information, np.swapaxes(b, 1, 2) @ information
        blocks = np.concatenate([ai @ a, ai @ b, bi @ a, bi @ b])
        gradient = np.zeros((n, 3))
        np.add.at(gradient, first, np.einsum("mij,mj->mi", ai, errors))
        np.add.at(gradient, second, np.einsum("mij,mj->mi", bi, errors))
        keep = (rows >= 3) & (columns >= 3)
        matrix = csc_matrix((blocks.ravel()[keep], (rows[keep] - 3, columns[keep] - 3)), shape=(3 * n - 3, 3 * n - 3))
        matrix.setdiag(matrix.diagonal() * (1 + 1e-9) + 1e-9)
        step = splu(matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(-gradient.ravel()[3:])
        poses[1:] += step.reshape(-1, 3)
        poses[:, 2] = wrap(poses[:, 2])
        errors = _errors(poses, edges)
        if np.abs(step).max() < 1e-4:
            break
    return poses, np.sqrt(np.einsum("mi,mij,mj->m", errors, edges.information, errors))


def _errors(poses: Floats, edges: Edges) -> Floats:
    found = between(poses[edges.pairs[:, 0]], poses[edges.pairs[:, 1]])
    errors = found - edges.motions
    errors[:, 2] = wrap(errors[:, 2])
    return errors


def _jacobians(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Of the error by the first pose and by the second, each m by 3 by 3."""
    cos, sin = np.cos(a[:, 2]), np.sin(a[:, 2])
    dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    by_a, by_b = np.zeros((len(a), 3, 3)), np.zeros((len(a), 3, 3))
    by_b[:, 0, 0], by_b[:, 0, 1], by_b[:, 1, 0], by_b[:, 1, 1], by_b[:, 2, 2] = cos, sin, -sin, cos, 1
    by_a[:, :2, :2] = -by_b[:, :2, :2]
    by_a[:, 0, 2], by_a[:, 1, 2], by_a[:, 2, 2] = cos * dy - sin * dx, -cos * dx - sin * dy, -1
    return by_a, by_b


def _pattern(first: NDArray[np.int64], second: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of the numbers in the blocks (aa, ab, ba, bb)."""
    down, across = np.repeat(np.arange(3), 3), np.tile(np.arange(3), 3)
    lefts = np.concatenate([first, first, second, second])
    rights = np.concatenate([first, second, first, second])
    return (3 * lefts[:, None] + down).ravel(), (3 * rights[:, None] + across).ravel()
