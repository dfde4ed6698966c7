import math
from dataclasses import replace
from math import inf, nan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.messages import LaserScan, Range, Twist
from skytether.robot.safety.geometry.footprint import circle
from skytether.robot.safety.sensing.ranges import MAX_RAYS, Mount, Sight
from skytether.robot.safety.sensing.ranges import view as view_of

OUTLINE = circle(0.2)


def view(mount, message, before=None):
    """Of a robot of 0.2 m, and of lasers with few and wide rays, so that tests can be read."""
    wide = replace(mount, max_step=math.radians(90), min_rays=1)
    return view_of(wide, OUTLINE, message, before)


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
    # In range, beyond, nothing, no reading, no echo.
    seen = view(Mount(), scan([2.0, 10.0, inf, nan, 0.0]))
    assert seen.sight is Sight.CLEAR  # two rays without a reading beside each other are no gap
    assert np.hypot(*seen.points.T) == pytest.approx([2.0])
    assert np.hypot(*seen.edge.T) == pytest.approx([10.0, 10.0])


@pytest.mark.parametrize("value", [0.05, 0.0999, -1.0, -inf])
def test_what_is_too_close_may_be_at_the_outline_or_where_measuring_begins_and_nothing_is_known_behind(value):
    ranges = [3.0] * 80 + [value] * 21 + [3.0] * 80
    seen = view(Mount(), scan(ranges, range_min=0.3))
    assert seen.sight is Sight.CLEAR
    distances = np.sort(np.hypot(*seen.points.T))
    assert distances[:21] == pytest.approx(0.2, abs=0.005)  # the robot's outline
    assert distances[21:42] == pytest.approx(0.3)
    # 20 degrees of the cells ahead, a quarter of a degree each, are not looked into.
    ahead = np.flatnonzero(~seen.looks)
    assert {0, 36, 1439, 1440 - 36} <= set(ahead)
    assert seen.looks[60]
    assert seen.looks[1440 - 60]


@pytest.mark.parametrize("value", [0.05, -1.0, -inf])
def test_a_laser_that_finds_everything_too_close_is_blind(value):
    seen = view(Mount(), scan([value] * 181))
    assert seen.sight is Sight.BLIND
    assert "too close" in seen.detail
    assert not seen.looks.any()


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
    assert "7 degrees" in seen.detail  # from reading to reading
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


@pytest.mark.parametrize("turns", [-1, 0, 1])
def test_ignored_sectors_count_whole_turns_more_or_less_and_go_over_the_seam(turns):
    # The robot's own post from 170 to 190 degrees, 360 rays from 0, or from -180, degrees on.
    ignore = ((math.radians(170 + 360 * turns), math.radians(-170 + 360 * turns)),)
    for start in (0, -180):
        degrees = start + np.arange(360)
        ranges = np.where(np.abs((degrees % 360) - 180) <= 10, 0.15, 3.0)
        seen = view(Mount(ignore=ignore), scan(ranges, angle_min=math.radians(start)))
        assert (seen.sight, len(seen.points)) == (Sight.CLEAR, 339)


def test_a_field_of_view_that_shrinks_is_blindness():
    whole = view(Mount(), scan([3.0] * 181))
    half = scan([3.0] * 91, angle_min=0.0)
    assert view(Mount(), half).sight is Sight.CLEAR
    seen = view(Mount(), half, whole.spans)
    assert (seen.sight, len(seen.points)) == (Sight.BLIND, 91)
    assert "no reading over 90 degrees" in seen.detail
    asked = Mount(fov=(math.radians(-90), math.radians(90)))
    assert view(asked, half).sight is Sight.BLIND
    assert view(asked, scan([3.0] * 181)).sight is Sight.CLEAR
    # Four degrees less are within what may be missing.
    assert view(asked, scan([3.0] * 177)).sight is Sight.CLEAR


@pytest.mark.parametrize(
    ("message", "says"),
    [
        (scan([3.0], angle_min=math.pi), "1 rays"),  # one ray backwards
        (scan([3.0] * 4, angle_min=math.pi / 4, angle_increment=math.pi / 2), "4 rays"),
        (scan([3.0] * 36, angle_increment=math.radians(10)), "10.0 degrees apart"),
        (scan([3.0] * 100, angle_max=math.pi / 2), "not where its 100 rays end"),  # 81 rays fell out
    ],
)
def test_a_scan_of_too_few_rays_is_nonsense(message, says):
    seen = view_of(Mount(), OUTLINE, message)
    assert seen.sight is Sight.NONSENSE
    assert says in seen.detail


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
        (-inf, Sight.CLEAR, 18),  # at the robot's outline, and where it begins to measure
    ],
)
def test_a_sonar_without_an_echo_is_an_ordinary_sonar(value, sight, points):
    seen = view(Mount(), Range(field_of_view=0.5, min_range=0.1, max_range=3.0, range=value))
    assert (seen.sight, len(seen.points)) == (sight, points)


@pytest.mark.parametrize(
    ("value", "sight", "points"),
    [(-inf, Sight.CLEAR, 18), (0.4, Sight.CLEAR, 18), (inf, Sight.CLEAR, 0), (nan, Sight.BLIND, 0)],
)
def test_a_sensor_of_one_fixed_distance_says_only_whether_something_is_there(value, sight, points):
    seen = view(Mount(), Range(field_of_view=0.2, min_range=0.4, max_range=0.4, range=value))
    assert (seen.sight, len(seen.points)) == (sight, points)
    assert seen.looks.any() == (value == inf)


def test_a_cone_that_becomes_narrower_is_blind():
    wide = view(Mount(), Range(field_of_view=1.0, min_range=0.1, max_range=3.0, range=2.0))
    narrow = Range(field_of_view=0.5, min_range=0.1, max_range=3.0, range=2.0)
    assert view(Mount(), narrow).sight is Sight.CLEAR
    assert view(Mount(), narrow, wide.spans).sight is Sight.BLIND


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


def test_what_is_remembered_of_a_scans_rays_is_never_another_scans():
    """The same rays are reckoned once: what they measure, which way they go and what is ignored counts each time."""
    ahead = (math.radians(-5), math.radians(5))
    rising = scan([2.0] * 100 + [nan] * 20 + [2.0] * 61)
    falling = scan([2.0] * 181, angle_min=math.pi / 2, angle_increment=-math.radians(1))
    asked = [(Mount(), rising), (Mount(), falling), (Mount(ignore=(ahead,)), rising), (Mount(fov=ahead), rising)]
    first = [view(*each) for each in asked]
    assert [seen.sight for seen in first] == [Sight.BLIND, Sight.CLEAR, Sight.BLIND, Sight.CLEAR]
    for seen, again in zip(first[::-1], [view(*each) for each in asked[::-1]], strict=True):
        assert again.points.tolist() == seen.points.tolist()
        assert (again.looks == seen.looks).all()
        assert (again.spans == seen.spans).all()
    assert first[0].looks.sum() < first[1].looks.sum()
    assert view(Mount(), scan([2.0] * 181)).looks.sum() == first[1].looks.sum()
