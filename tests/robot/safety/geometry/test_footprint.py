import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from skytether.robot.safety.geometry.footprint import Footprint, Outlines, circle, polygon

SQUARE = polygon([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])


def at(*points: tuple[float, float]) -> np.ndarray:
    return np.array(points, dtype=float)


def test_the_hull_takes_corners_in_any_order_and_drops_what_is_inside():
    hull = polygon([(0.5, 0.5), (-0.5, -0.5), (0.1, 0.1), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.0)])
    assert hull.vertices.tolist() == [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]
    assert hull.radius == pytest.approx(math.sqrt(0.5))


@pytest.mark.parametrize(
    "corners", [[], [(0, 0)], [(0, 0), (1, 1)], [(0, 0), (1, 1), (2, 2)], [(0, 0), (1, 0), (0, math.nan)]]
)
def test_what_has_no_area_is_refused(corners):
    with pytest.raises(ValueError, match="footprint: "):
        polygon(corners)


@pytest.mark.parametrize("radius", [0, -1, math.nan, math.inf])
def test_a_circle_needs_a_radius(radius):
    with pytest.raises(ValueError, match="radius must be above 0"):
        circle(radius)


def test_a_circle_is_never_too_small():
    # The corners of a 16-gon around a circle are 1 / cos(pi / 16) = 1.0196 radii out, its edges touch it.
    round_ = circle(0.3)
    assert round_.radius == pytest.approx(0.3 / math.cos(math.pi / 16))
    rim = at(*[(0.3 * math.cos(a), 0.3 * math.sin(a)) for a in np.linspace(0, math.tau, 100)])
    assert round_.outside(rim).max() <= 1e-12


def test_room_is_kept_on_every_side():
    bigger = SQUARE.inflated(0.2)
    # Straight out of an edge it is exactly 0.2, at a corner the octagon's 0.2 / cos(pi / 8) = 0.2165 at most.
    assert bigger.outside(at((0.7, 0), (0, -0.7))) == pytest.approx([0, 0], abs=1e-12)
    diagonal = 0.5 + 0.2 / math.sqrt(2)
    assert -0.0166 <= bigger.outside(at((diagonal, diagonal)))[0] <= 1e-12
    assert SQUARE.inflated(0) is SQUARE


def test_straight_on():
    # From the front edge at 0.5 to the wall at 1.5: 1 m at 0.25 m/s.
    assert SQUARE.time_to_contact(at((1.5, 0.0)), 0.25, 0.0) == pytest.approx(4.0)
    assert SQUARE.time_to_contact(at((1.5, 0.0)), -0.25, 0.0) == math.inf
    assert SQUARE.time_to_contact(at((-1.5, 0.2)), -0.25, 0.0) == pytest.approx(4.0)
    assert SQUARE.time_to_contact(at((1.5, 0.51)), 0.25, 0.0) == math.inf
    assert SQUARE.time_to_contact(at((1.5, 0.51), (2.5, 0.1)), 0.25, 0.0) == pytest.approx(8.0)


def test_turning_on_the_spot():
    point = at((0.6, 0.0))
    # Seen from the robot that turns left at 1 rad/s the point goes right on a circle of 0.6 m, and enters the square
    # through the front edge x = 0.5, where its bearing is -acos(0.5 / 0.6).
    assert SQUARE.time_to_contact(point, 0.0, 1.0) == pytest.approx(math.acos(0.5 / 0.6))
    assert SQUARE.time_to_contact(point, 0.0, -2.0) == pytest.approx(math.acos(0.5 / 0.6) / 2)
    assert SQUARE.time_to_contact(at((0.71, 0.0)), 0.0, 1.0) == math.inf  # beyond every corner, 0.7071


def test_on_an_arc():
    # v / w = 1: the centre of the turn is (0, 1). A point at (0, 1 + 1.2) is 1.2 m from it; the square's farthest
    # corner (0.5, -0.5) is sqrt(0.25 + 2.25) = 1.58 m from it. The point is met by the front edge x = 0.5 where
    # 0.5^2 + y^2 = 1.2^2, below the centre: y = -1.0909, at (0.5, -0.0909). Its bearing from the centre goes from
    # +90 degrees clockwise (the robot turns left) to atan2(-1.0909, 0.5).
    y = -math.sqrt(1.2**2 - 0.25)
    angle = math.pi / 2 - math.atan2(y, 0.5)
    assert SQUARE.time_to_contact(at((0.0, 2.2)), 0.5, 0.5) == pytest.approx(angle / 0.5)
    assert SQUARE.time_to_contact(at((0.0, 2.2 + 0.5)), 0.5, 0.5) == math.inf  # 1.7 m from the centre


def test_a_standstill_touches_nothing():
    assert SQUARE.time_to_contact(at((0.0, 0.0), (9.0, 0.0)), 0.0, 0.0) == math.inf
    assert SQUARE.time_to_contact(np.empty((0, 2)), 1.0, 0.0) == math.inf


@pytest.mark.parametrize(
    ("point", "linear", "angular", "contact"),
    [
        ((0.45, 0.0), 0.2, 0.0, 0.0),  # just inside the front: not on
        ((0.45, 0.0), -0.2, 0.0, math.inf),  # but back
        ((-0.45, 0.0), 0.2, 0.0, math.inf),  # just inside the rear: on
        ((-0.45, 0.0), -0.2, 0.0, 0.0),
        ((0.0, 0.45), 0.2, 0.0, math.inf),  # beside: along it, both ways
        ((0.0, 0.45), -0.2, 0.0, math.inf),
        ((0.3, 0.45), 0.0, 0.5, 0.0),  # ahead on the left: turning left brings the left side nearer
        ((0.3, 0.45), 0.0, -0.5, math.inf),
        ((0.5, 0.0), 0.2, 0.0, 0.0),  # on the edge
    ],
)
def test_from_within_the_robot_may_go_but_not_on(point, linear, angular, contact):
    assert SQUARE.time_to_contact(at(point), linear, angular) == contact


shapes = st.sampled_from([SQUARE, circle(0.3), polygon([(0.6, 0.0), (-0.2, 0.3), (-0.2, -0.3)])])
speeds = st.one_of(st.just(0.0), st.floats(-1, 1).filter(lambda v: abs(v) > 1e-3))


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(shapes, st.tuples(st.floats(-2, 2), st.floats(-2, 2)), speeds, speeds)
def test_contact_is_where_a_simulation_with_small_steps_finds_it(shape: Footprint, point, linear, angular):
    found = shape.time_to_contact(at(point), linear, angular)
    if shape.outside(at(point))[0] <= 1e-6 or linear == angular == 0:
        return
    horizon = min(found * 0.999, 10.0)
    for t in np.linspace(0.0, horizon, 400):
        assert shape.outside(at(_seen(point, linear, angular, t)))[0] > -1e-6
    if found < math.inf:
        assert abs(shape.outside(at(_seen(point, linear, angular, found)))[0]) < 1e-6


def _seen(point: tuple[float, float], linear: float, angular: float, t: float) -> tuple[float, float]:
    """Where a point is as seen from the robot after t seconds of constant velocity."""
    if angular == 0:
        return point[0] - linear * t, point[1]
    turn, radius = angular * t, linear / angular
    x, y = point[0] - radius * math.sin(turn), point[1] - radius * (1 - math.cos(turn))
    return x * math.cos(turn) + y * math.sin(turn), -x * math.sin(turn) + y * math.cos(turn)


@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=3, max_size=8), st.floats(0.0, 0.5))
@example([(0.0, 0.0), (0.0, 1.0), (-7.5e-12, 1.0), (-1.0, 0.5)], 0.5)
@example([(0.0, 0.0), (0.0, 1.0), (-2e-6, 1.0)], 0.5)
def test_more_room_around_is_the_same_as_so_much_room_at_once(corners, more):
    try:
        outline = polygon(corners)
    except ValueError:
        return
    grown = Outlines(outline, 0.1)(more)
    room = (0.1 + more) / math.cos(math.pi / 8)
    turns = [(i + 0.5) * math.pi / 4 for i in range(8)]
    whole = polygon((x + room * math.cos(t), y + room * math.sin(t)) for x, y in outline.vertices for t in turns)
    # Neither has a corner outside of the other, but for the micrometre of `polygon`.
    assert grown.outside(whole.vertices).max() <= 2e-6
    assert whole.outside(grown.vertices).max() <= 2e-6
