import math
from math import inf, nan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.messages import LaserScan, Range, Twist
from skytether.robot.safety.ranges import MAX_RAYS, Mount, Sight, view


def scan(ranges, **fields) -> LaserScan:
    """Rays from -90 degrees to the left, 1 degree apart, 0.1 to 10 m."""
    values = {"angle_min": -math.pi / 2, "angle_increment": math.radians(1), "range_min": 0.1, "range_max": 10.0}
    return LaserScan(ranges=np.array(ranges, dtype=np.float32), **(values | fields))


def test_points_are_in_the_base_frame():
    # Three rays to the right, ahead and to the left of a laser that looks left (90 degrees) from (0.2, 0.1).
    message = scan([1.0, 2.0, 3.0], angle_increment=math.pi / 2)
    seen = view(Mount(x=0.2, y=0.1, yaw=math.pi / 2), message)
    assert seen.sight is Sight.CLEAR
    assert seen.points == pytest.approx(np.array([[1.2, 0.1], [0.2, 2.1], [-2.8, 0.1]]), abs=1e-6)


def test_head_over_left_is_right():
    message = scan([1.0, 2.0, 3.0], angle_increment=math.pi / 2)
    seen = view(Mount(upside_down=True), message)
    assert seen.points == pytest.approx(np.array([[0, 1], [2, 0], [0, -3]]), abs=1e-6)


def test_what_each_reading_means():
    # In range, beyond, nothing, too close, too close to say, no reading, no echo.
    seen = view(Mount(), scan([2.0, 10.0, inf, 0.05, -inf, nan, 0.0]))
    assert seen.sight is Sight.CLEAR  # two rays without a reading beside each other are no gap
    distances = np.hypot(*seen.points.T)
    assert distances == pytest.approx([2.0, 0.05, 0.0])


@pytest.mark.parametrize("value", [0.0, nan])
def test_a_laser_of_zero_ranges_or_nan_is_blind_even_where_no_echo_is_free(value):
    for mount in (Mount(), Mount(no_echo_is_free=True)):
        seen = view(mount, scan([value] * 181))
        assert (seen.sight, len(seen.points)) == (Sight.BLIND, 0)
        assert "no reading at all" in seen.detail


def test_a_gap_of_readings_is_blind_and_what_is_seen_beside_it_still_counts():
    # 6 rays of 1 degree are more than the 5 degrees that may be missing; 5 are not.
    seen = view(Mount(), scan([1.0] * 10 + [0.0] * 6 + [1.0] * 10))
    assert (seen.sight, len(seen.points)) == (Sight.BLIND, 20)
    assert "6 degrees" in seen.detail
    assert view(Mount(), scan([1.0] * 10 + [nan] * 5 + [1.0] * 10)).sight is Sight.CLEAR
    assert view(Mount(no_echo_is_free=True), scan([1.0] * 10 + [0.0] * 60)).sight is Sight.CLEAR


@pytest.mark.parametrize("value", [10.0, 12.0, inf])
def test_nothing_anywhere_is_its_own_case(value):
    seen = view(Mount(), scan([value] * 181))
    assert (seen.sight, len(seen.points)) == (Sight.EMPTY, 0)


def test_sectors_in_which_the_robot_sees_itself_are_left_out():
    # Rays 0 to 20 are at -90 to -70 degrees.
    ranges = [0.15] * 21 + [3.0] * 160
    ignore = ((math.radians(-90.1), math.radians(-69.9)),)
    seen = view(Mount(ignore=ignore), scan(ranges))
    assert (seen.sight, len(seen.points)) == (Sight.CLEAR, 160)
    assert view(Mount(ignore=((-4.0, 4.0),)), scan(ranges)).sight is Sight.BLIND


@pytest.mark.parametrize(
    "fields",
    [
        {"angle_increment": 0.0},
        {"angle_increment": nan},
        {"angle_min": inf},
        {"angle_min": 1e9},
        {"angle_increment": 1.0},  # 181 rays over 29 turns
        {"range_min": 11.0},
        {"range_min": -1.0},
        {"range_max": nan},
        {"range_min": nan},
    ],
)
def test_a_message_that_makes_no_sense_is_nonsense(fields):
    seen = view(Mount(), scan([1.0] * 181, **fields))
    assert (seen.sight, len(seen.points)) == (Sight.NONSENSE, 0)
    assert seen.detail


def test_no_rays_too_many_and_another_type_are_nonsense():
    assert view(Mount(), scan([])).sight is Sight.NONSENSE
    assert view(Mount(), scan([1.0] * (MAX_RAYS + 1), angle_increment=1e-4)).sight is Sight.NONSENSE
    assert "Twist" in view(Mount(), Twist()).detail


def test_the_configured_limits_go_before_the_message():
    seen = view(Mount(range_max=2.0), scan([1.0, 3.0], range_min=nan, range_max=nan))
    assert seen.sight is Sight.NONSENSE
    seen = view(Mount(range_min=0.1, range_max=2.0), scan([1.0, 3.0], range_min=nan, range_max=nan))
    assert (seen.sight, len(seen.points)) == (Sight.CLEAR, 1)


def test_a_sonar_sees_an_arc():
    cone = Range(field_of_view=math.pi / 3, min_range=0.1, max_range=3.0, range=1.0)
    seen = view(Mount(x=0.3), cone)
    assert seen.sight is Sight.CLEAR
    # 60 degrees about straight ahead, 1 m away: from (0.3 + cos 30, -sin 30) over (1.3, 0) to the left.
    assert seen.points[0] == pytest.approx([0.3 + math.sqrt(0.75), -0.5])
    assert seen.points[4] == pytest.approx([1.3, 0.0])


@pytest.mark.parametrize(
    ("value", "sight", "points"),
    [
        (3.0, Sight.CLEAR, 0),
        (inf, Sight.CLEAR, 0),
        (0.0, Sight.BLIND, 0),
        (nan, Sight.BLIND, 0),
        (-inf, Sight.CLEAR, 9),
    ],
)
def test_a_sonar_without_an_echo_is_an_ordinary_sonar(value, sight, points):
    seen = view(Mount(), Range(field_of_view=0.5, min_range=0.1, max_range=3.0, range=value))
    assert (seen.sight, len(seen.points)) == (sight, points)


wild = st.floats(allow_nan=True, allow_infinity=True, width=32)


@settings(max_examples=60, deadline=None)
@given(st.lists(wild, max_size=40), wild, wild, wild, wild, st.booleans())
def test_any_scan_gives_finite_points_and_never_raises(ranges, angle_min, increment, near, far, free):
    message = scan(ranges, angle_min=angle_min, angle_increment=increment, range_min=near, range_max=far)
    seen = view(Mount(no_echo_is_free=free), message)
    assert np.isfinite(seen.points).all()
    assert seen.points.shape[1] == 2
    cone = view(Mount(), Range(field_of_view=angle_min, min_range=near, max_range=far, range=increment))
    assert np.isfinite(cone.points).all()
