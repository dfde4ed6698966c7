from __future__ import annotations

import numpy as np

from skytether_services.navigation.pose_graph import Edges, optimise
from skytether_services.navigation.poses import between, compose


def test_compose_undoes_between() -> None:
    a, b = np.array([1.0, 2, 0.5]), np.array([-1.0, 4, 3])
    np.testing.assert_allclose(compose(a, between(a, b)), b)
    # Straight ahead of a pose that looks along y is larger y.
    np.testing.assert_allclose(compose(np.array([1.0, 2, np.pi / 2]), np.array([3.0, 0, 0])), [1, 5, np.pi / 2])


def edges(motions: list[float], loop: float, also: float | None = None) -> Edges:
    """A line of poses 1 m apart by their motions, and loops from the first pose to the last."""
    n = len(motions)
    pairs = [(i, i + 1) for i in range(n)] + [(0, n)] * (2 if also is not None else 1)
    along = [*motions, loop] + ([also] if also is not None else [])
    table = np.zeros((len(along), 3))
    table[:, 0] = along
    information = np.tile(np.diag([1e4, 1e4, 1e4]), (len(along), 1, 1))
    return Edges(np.array(pairs), table, information, np.array([False] * n + [True] * (len(along) - n)))


def test_an_error_is_shared_by_equal_edges() -> None:
    # Three motions of 1 m and a loop of 3.04 m with equal information: each of the four errs by 0.01 m, one standard
    # deviation (1e4 is 0.01 m). The kernel gives the loop less than its share: with w = 1 / (1 + e²/9) and
    # w (0.04 - 3 d) = d, d in standard deviations of 0.01 m, d is 0.9646.
    poses, errors = optimise(np.zeros((4, 3)), edges([1, 1, 1], 3.04))
    d = (poses[3, 0] - 3) / 3 * 100
    e = 4 - 3 * d
    np.testing.assert_allclose(e / (1 + e * e / 9), d, atol=2e-3)
    np.testing.assert_allclose(errors[:3], d, atol=1e-6)


def test_a_loop_that_is_wrong_moves_little() -> None:
    poses, errors = optimise(np.zeros((4, 3)), edges([1, 1, 1], 3.0, 8.0))
    assert abs(poses[3, 0] - 3) < 0.02
    assert errors[-1] > 400
