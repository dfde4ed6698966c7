import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.robot.safety.geometry.footprint import circle, polygon
from skytether.robot.safety.sensing.coverage import (
    CELLS,
    Action,
    Cover,
    Unseen,
    UnseenParams,
    between,
    no_cells,
    sector,
    widest,
)

BOX = polygon([(0.3, 0.25), (0.3, -0.25), (-0.3, -0.25), (-0.3, 0.25)])
"""0.6 m long, 0.5 m wide, turning about its middle; its corners are 0.39 m away from that."""


def rad(*degrees: float) -> list[float]:
    return [math.radians(d) for d in degrees]


def cover(first: float, last: float, x: float = 0.25, yaw: float = 0.0, **fields: float) -> Cover:
    reach = np.where(sector(*rad(first, last)), math.inf, 0.0)
    return Cover(x, 0.0, math.radians(yaw), 1.0, reach, **fields)


FRONT = cover(-90, 90)
REAR = cover(-90, 90, x=-0.25, yaw=180)
ALL = cover(-180, 180, x=0.0)


def test_sectors_are_cells_wholly_within_or_touched():
    # A quarter of a degree each: 10 to 20 degrees are cells 40 to 79.
    assert np.flatnonzero(sector(*rad(10, 20))).tolist() == list(range(40, 80))
    assert np.flatnonzero(sector(*rad(10.1, 10.6))).tolist() == [41]
    assert np.flatnonzero(sector(*rad(10.1, 10.6), touched=True)).tolist() == [40, 41, 42]
    assert sector(*rad(-180, 180)).all()
    assert np.flatnonzero(sector(*rad(359, -359))).tolist() == [0, 1, 2, 3, 1436, 1437, 1438, 1439]
    assert not sector(0.0, 0.0).any()


def test_rays_look_into_what_is_between_them_up_to_a_gap():
    # 0 to 10 degrees, a gap of 4 missing rays, 15 to 20 degrees, a gap of 9, 30 degrees alone.
    angles = np.radians([*range(11), *range(15, 21), 30])
    seen = between(angles, math.radians(1), math.radians(5))
    assert np.flatnonzero(seen).tolist() == list(range(80))
    seen = between(angles, math.radians(1), math.radians(3))
    assert np.flatnonzero(seen).tolist() == [*range(40), *range(60, 80)]


def test_rays_close_the_turn_over_the_seam_and_four_of_them_do_not():
    assert between(np.radians(np.arange(360)), math.radians(1), 0.0).all()
    assert between(np.radians(np.arange(-180, 180)), math.radians(1), 0.0).all()
    assert not between(np.radians([0, 90, 180, 270]), 0.0, math.radians(5)).any()
    assert not between(np.radians([180]), 0.0, math.radians(5)).any()


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(0, 359), unique=True), st.integers(-359, 359), st.sampled_from([-360, 0, 360]))
def test_where_a_scan_begins_and_whole_turns_make_no_difference(missing, start, turn):
    degrees = np.arange(start, start + 360)
    degrees = degrees[~np.isin(degrees % 360, missing)]
    seen = between(np.radians(degrees + turn), math.radians(1), math.radians(2))
    # The oracle: a cell is looked into if the rays around it are at most 3 degrees apart.
    rays = {d % 360 for d in degrees.tolist()}
    expected = [
        any(
            (cell // 4 - before) % 360 in rays
            and any((cell // 4 + after) % 360 in rays for after in range(1, 4 - before))
            for before in range(3)
        )
        for cell in range(CELLS)
    ]
    assert seen.tolist() == expected


def test_the_widest_sector_goes_over_the_seam():
    assert widest(no_cells()) == 0
    assert widest(np.ones(CELLS, dtype=bool)) == pytest.approx(math.tau)
    assert widest(sector(*rad(-10, 20)) | sector(*rad(90, 110))) == pytest.approx(math.radians(30))


def test_a_cover_knows_directions_and_how_far():
    points = np.array([[1.25, 0.0], [0.25, 1.0], [0.2, 1.0], [-1.0, 0.0]])
    assert FRONT.looks_at(points).tolist() == [True, False, False, False]
    assert cover(-91, 91).looks_at(points).tolist() == [True, True, False, False]
    left = Cover(0.0, 0.0, math.pi / 2, -1.0, np.where(sector(*rad(0, 90)), 2.0, 0.0), near=0.5)
    # It looks left, head over: from there to the right, that is from left to ahead, from 0.5 to 2 m.
    points = np.array([[0.7, 0.7], [-0.7, 0.7], [2.0, 2.0], [0.2, 0.2]])
    assert left.looks_at(points).tolist() == [True, False, False, False]


def share(velocity: tuple[float, float], covers, action=Action.SLOW, outline=BOX, near=0.05) -> float:
    return Unseen(UnseenParams(action, near), outline, 0.1).share(Velocity(*velocity), covers, 0.4)


def test_with_a_front_laser_it_drives_reverses_slowly_and_turns_slowly():
    assert share((0.5, 0.0), [FRONT]) == 1.0
    assert share((0.5, 0.2), [FRONT]) == 1.0  # the corner behind swings out at 0.06 m/s
    # Backwards at 0.1 m/s instead of 0.5.
    assert share((-0.5, 0.0), [FRONT]) == pytest.approx(0.2)
    assert share((-0.08, 0.0), [FRONT]) == 1.0
    # On the spot a corner goes out to the side at 0.3 m times the rate at most: 0.1 m/s and a bit at 0.4 rad/s.
    assert 0.3 < share((0.0, 1.0), [FRONT]) < 0.5
    assert share((0.0, 0.3), [FRONT]) == 1.0


def test_with_eyes_behind_too_or_all_around_nothing_is_held_back():
    for velocity in ((0.5, 0.0), (-0.5, 0.0), (0.4, 0.5), (0.0, 1.0), (-0.3, -0.6)):
        assert share(velocity, [ALL]) == 1.0
    assert share((-0.5, 0.0), [FRONT, REAR]) == 1.0


def test_what_is_not_looked_at_may_be_forbidden_or_free():
    assert share((-0.05, 0.0), [FRONT], Action.STOP) == 0.0
    assert share((0.0, 0.3), [FRONT], Action.STOP) == 0.0
    assert share((0.5, 0.0), [FRONT], Action.STOP) == 1.0
    assert share((0.5, 0.3), [], Action.FREE) == 1.0
    assert share((0.5, 0.0), [], Action.STOP) == 0.0
    assert share(STANDSTILL, [], Action.STOP) == 1.0


def test_a_round_robot_may_turn_on_the_spot_unseen():
    assert share((0.0, 2.0), [], Action.STOP, circle(0.3)) == 1.0
    assert share((0.2, 2.0), [], Action.STOP, circle(0.3)) == 0.0


def test_a_camera_that_does_not_see_its_own_corners_needs_near_m():
    camera = cover(-35, 35, x=0.3)
    assert share((0.5, 0.0), [camera]) == pytest.approx(0.2)
    # 0.25 m to each side are within 35 degrees from 0.36 m on.
    assert share((0.5, 0.0), [camera], near=0.4) == 1.0
    assert share((-0.5, 0.0), [camera], near=0.4) == pytest.approx(0.2)
    assert share((0.5, 0.0), [cover(-10, 10, x=0.3)], near=0.4) == pytest.approx(0.2)


@pytest.mark.parametrize("hole", [(-12, -4), (-3, 3), (5, 12)])
def test_a_hole_in_the_view_ahead_is_found(hole):
    reach = np.where(sector(*rad(-90, 90)) & ~sector(*rad(*hole)), math.inf, 0.0)
    assert share((0.5, 0.0), [Cover(0.25, 0.0, 0.0, 1.0, reach)]) == pytest.approx(0.2)
