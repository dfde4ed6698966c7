"""What an outline covers on its way: never less than the zones look at, and hardly more."""

from math import hypot, inf, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.robot.safety.geometry.footprint import circle, polygon
from skytether.robot.safety.geometry.sweep import boundary, moved, swept

SQUARE = polygon([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
LORRY = polygon([(1.5, 0.4), (1.5, -0.4), (-0.3, -0.4), (-0.3, 0.4)])
OUTLINES = st.sampled_from([SQUARE, LORRY, LORRY.inflated(0.1), circle(0.3)])
SPEEDS = st.one_of(st.sampled_from([0.0, 0.5, -0.5]), st.floats(-1, 1))
VELOCITIES = st.builds(Velocity, SPEEDS, SPEEDS)
TIMES = st.floats(0, 4)
ROUNDED = 3e-6


def depth(pieces, points):
    """How far each point is outside of the pieces, below zero within."""
    return np.min([piece.outside(points) for piece in pieces], axis=0)


def some_points(seed, most=4.0):
    return np.random.default_rng(seed).uniform(-most, most, (300, 2))


@settings(max_examples=100)
@given(OUTLINES, VELOCITIES, TIMES, st.integers(0, 1000))
def test_what_is_touched_on_the_way_is_in_the_pieces(outline, velocity, time, seed):
    points = some_points(seed)
    touched = outline.times_to_contact(points, *velocity) <= time
    assert (depth(swept(outline, velocity, time), points[touched]) <= ROUNDED).all()


@given(OUTLINES, VELOCITIES, st.floats(0, 1))
def test_they_are_hardly_more_than_what_is_covered(outline, velocity, time):
    points = boundary(swept(outline, velocity, time))
    least = np.full(len(points), inf)
    for moment in np.linspace(0, time, 400):
        # Where a point lies for the robot then: moved back by the same turn.
        there = moved(np.zeros((1, 2)), velocity, moment)[0]
        turn = velocity.angular * moment
        c, s = np.cos(turn), np.sin(turn)
        least = np.minimum(least, outline.outside((points - there) @ np.array([[c, -s], [s, c]])))
    # 2 cm, 5 mm between two moments on the longest way, and what a wide curve that counts as straight is beside it.
    assert (least <= 0.02 + 0.5 * 0.01 * (1 + outline.radius) + 1e-4 * 16).all()


@settings(max_examples=50)
@given(OUTLINES, VELOCITIES, TIMES, st.integers(0, 1000))
def test_nothing_gets_in_but_across_their_boundary_and_all_of_it_is_their_edge(outline, velocity, time, seed):
    pieces = swept(outline, velocity, time)
    a, b = boundary(pieces).reshape(-1, 2, 2).transpose(1, 0, 2)
    long = np.hypot(*(b - a).T) > 1e-3
    across = (b - a)[long] @ np.array([[0, 1], [-1, 0]]) / np.hypot(*(b - a)[long].T)[:, None]
    middles = (a + b)[long] / 2
    sides = [depth(pieces, middles + offset * across) > 0 for offset in (1e-4, -1e-4)]
    assert (sides[0] | sides[1]).all()
    points = some_points(seed)
    points = points[depth(pieces, points) < -1e-3]
    for x, y in points[:20]:  # whoever goes far away crosses a line
        far = np.array((20.0, 1.0))
        here = np.array((x, y))
        assert crosses(here, far, a, b).any()


def crosses(start, end, a, b):
    """Which of the lines from ``a`` to ``b`` the way from start to end crosses."""

    def left(p, q, r):
        return (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1]) - (q[..., 1] - p[..., 1]) * (r[..., 0] - p[..., 0])

    return (left(start, end, a) * left(start, end, b) <= 0) & (left(a, b, start) * left(a, b, end) <= 0)


def test_straight_on_it_is_one_piece():
    (piece,) = swept(SQUARE, Velocity(0.5, 0.0), 2.0)
    assert piece.vertices.tolist() == [[-0.5, -0.5], [1.5, -0.5], [1.5, 0.5], [-0.5, 0.5]]
    assert len(boundary((piece,))) == 8


def test_who_stands_covers_the_outline_alone():
    assert swept(SQUARE, STANDSTILL, 5.0) == (SQUARE,)
    assert swept(SQUARE, Velocity(0.5, 0.0), 0.0) == (SQUARE,)


def test_turning_on_the_spot_for_long_is_a_disc():
    pieces = swept(SQUARE, Velocity(0.0, 1.0), 1000.0)
    away = [hypot(x, y) for x, y in boundary(pieces)]
    assert min(away) >= SQUARE.radius - 1e-5
    assert max(away) <= SQUARE.radius + 0.03


@pytest.mark.parametrize("angular", [0.5, -0.5])
def test_a_quarter_of_a_turn(angular):
    # About (0, 1) or (0, -1), over pi / 2: from the origin to (1, 1) or (1, -1).
    end = moved(np.zeros((1, 2)), Velocity(0.5, angular), pi)[0]
    assert end.tolist() == pytest.approx([1.0, np.sign(angular)])
    pieces = swept(SQUARE, Velocity(0.5, angular), pi)
    assert (depth(pieces, moved(SQUARE.vertices, Velocity(0.5, angular), pi)) <= ROUNDED).all()
    assert depth(pieces, np.array([[2.2, 0.0], [-0.6, 0.0]])).min() > 0
