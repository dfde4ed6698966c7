import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.lab.trail import THESIS_TRAIL, Trail
from skytether_services.virtual_trail.params import THESIS_TRAIL as DEFAULT
from skytether_services.virtual_trail.params import Arc, Straight, path_of
from skytether_services.virtual_trail.path import Path, Pose, advance, wrap

QUARTER = Path([(1.0, 0.0), (math.pi / 2 * 2.0, 1 / 2.0), (1.0, 0.0)])
"""1 m straight on, a quarter circle of radius 2 m to the left, 1 m straight on: ends at (3, 3), heading +y."""


def test_wrap_keeps_the_direction() -> None:
    assert wrap(3 * math.pi / 2) == pytest.approx(-math.pi / 2)
    assert wrap(math.pi) == -math.pi


def test_advance_along_a_quarter_circle() -> None:
    # radius 2 to the right from the origin: centre (0, -2), ends at (2, -2) heading -y
    pose = advance(Pose(0, 0, 0), math.pi, -math.pi / 2)
    assert pose == pytest.approx((2, -2, -math.pi / 2))


def test_advance_straight_on_has_no_division_by_zero() -> None:
    assert advance(Pose(1, 2, math.pi / 2), 3, 0.0) == pytest.approx((1, 5, math.pi / 2))


def test_points_by_arc_length() -> None:
    assert QUARTER.length == pytest.approx(2 + math.pi)
    # half the arc: centre (1, 2), 45 degrees on
    half = math.sqrt(2)
    assert QUARTER.at(1 + math.pi / 2) == pytest.approx((1 + half, 2 - half, math.pi / 4))
    assert QUARTER.at(QUARTER.length) == pytest.approx((3, 3, math.pi / 2))


def test_goes_straight_on_beyond_both_ends() -> None:
    assert QUARTER.at(-0.5) == pytest.approx((-0.5, 0, 0))
    assert QUARTER.at(QUARTER.length + 2) == pytest.approx((3, 5, math.pi / 2))


def test_closest_on_each_kind_of_piece_and_at_the_ends() -> None:
    assert QUARTER.closest(0.4, 0.3) == pytest.approx(0.4)
    # on the ray from the centre (1, 2) at -45 degrees, inside and outside the circle
    assert QUARTER.closest(1 + 0.5, 2 - 0.5) == pytest.approx(1 + math.pi / 2)
    assert QUARTER.closest(1 + 3, 2 - 3) == pytest.approx(1 + math.pi / 2)
    assert QUARTER.closest(-1, 0.5) == 0
    assert QUARTER.closest(3.2, 9) == pytest.approx(QUARTER.length)


def test_closest_on_a_right_arc() -> None:
    path = Path([(math.pi, -1.0)])  # half circle to the right about (0, -1), to (0, -2)
    assert path.closest(2, -1) == pytest.approx(math.pi / 2)
    assert path.closest(-0.1, 0.5) == 0  # just behind the start, not round the back


def test_window_holds_progress_where_a_trail_comes_near_itself() -> None:
    there_and_back = Path([(3.0, 0.0), (math.pi * 0.5, 2.0), (3.0, 0.0)])  # back at a distance of 1 m
    assert there_and_back.closest(1.0, 0.9) > 6
    assert there_and_back.closest(1.0, 0.9, 0.5, 1.5) == pytest.approx(1.0)
    assert there_and_back.closest(0.2, 0.0, 0.5, 1.5) == 0.5  # never behind the window


@pytest.mark.parametrize(
    ("pieces", "sentence"),
    [
        ([], "at least one segment"),
        ([(1.0, 0.0), (0.0, 1.0)], "segment 2 must be longer than 0 m"),
        ([(7.0, 1.0)], "segment 1 is more than a full circle"),
    ],
)
def test_refuses_what_is_no_trail(pieces: list[tuple[float, float]], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        Path(pieces)


def test_default_is_the_trail_of_the_lab() -> None:
    pieces = [
        {"length": p.length} if isinstance(p, Straight) else {"radius": p.radius, "angle": p.angle} for p in DEFAULT
    ]
    assert pieces == list(THESIS_TRAIL)
    assert path_of(DEFAULT).length == pytest.approx(9.0)


def test_a_full_circle_is_a_trail_whatever_its_radius_rounds_to() -> None:
    for hundredth in range(10, 500):
        radius = hundredth / 100
        assert path_of([Arc(radius, -math.tau)]).length == pytest.approx(math.tau * radius)


def test_arcs_turn_to_the_side_of_their_angle() -> None:
    assert path_of([Arc(2.0, -math.pi / 2)]).at(math.pi) == pytest.approx((2, -2, -math.pi / 2))


segments = st.lists(
    st.one_of(
        st.builds(Straight, st.floats(0.3, 3)),
        st.builds(Arc, st.floats(0.5, 3), st.one_of(st.floats(0.2, 1.5), st.floats(-1.5, -0.2))),
    ),
    min_size=1,
    max_size=5,
)


@settings(max_examples=40, deadline=None)
@given(segments, st.floats(0, 1), st.floats(-0.3, 0.3))
def test_agrees_with_the_lab_s_polyline(trail: list[Straight | Arc], share: float, offset: float) -> None:
    path = path_of(trail)
    lab = Trail(
        [{"length": p.length} if isinstance(p, Straight) else {"radius": p.radius, "angle": p.angle} for p in trail]
    )
    assert path.length == pytest.approx(lab.length)
    s = share * path.length
    pose, reference = path.at(s), lab.at(s)
    assert pose[:2] == pytest.approx(reference[:2], abs=1e-4)
    assert abs(wrap(pose.heading - reference.heading)) < 0.025  # half a step of the polyline, on the tightest arc
    # A point beside the trail, found again by both. The window excludes other parts that pass nearby.
    x, y = pose.x - offset * math.sin(pose.heading), pose.y + offset * math.cos(pose.heading)
    assert path.closest(x, y, s - 0.2, s + 0.2) == pytest.approx(s, abs=1e-6)
    place = lab.locate(x, y, s - 0.2, s + 0.2)
    assert place.s == pytest.approx(s, abs=0.01)
    assert place.offset == pytest.approx(offset, abs=1e-3)


def test_lab_and_service_measure_the_same_distance_along_the_thesis_trail() -> None:
    path, lab = path_of(DEFAULT), Trail()
    random = np.random.default_rng(0)
    for s, offset in zip(np.linspace(0.1, 8.9, 60), random.uniform(-0.4, 0.4, 60), strict=True):
        pose = path.at(s)
        x, y = pose.x - offset * math.sin(pose.heading), pose.y + offset * math.cos(pose.heading)
        assert lab.locate(x, y).offset == pytest.approx(offset, abs=1e-4)
