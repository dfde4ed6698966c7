import math

import pytest

from skytether.control.pursuit import PursuitParams, Track, pursue

PARAMS = PursuitParams()
LINE = [(0.0, 0.0), (2.0, 0.0)]


def test_on_a_straight_it_drives_straight():
    assert pursue(PARAMS, Track(LINE), 0.5, 0.0, 0.0) == pytest.approx((0.2, 0.0))


def test_beside_it_the_curvature_is_that_of_the_arc_through_the_goal():
    # Goal at (0.4, 0.1) in the robot's frame: L^2 = 0.17, curvature 2 * 0.1 / 0.17, times 0.2 m/s.
    assert pursue(PARAMS, Track(LINE), 0.5, -0.1, 0.0) == pytest.approx((0.2, 0.2 * 0.2 / 0.17))


def test_a_turn_that_is_too_tight_is_driven_slower():
    linear, angular = pursue(PARAMS, Track([(0.0, 0.0), (0.0, 2.0)]), 0.0, 0.0, math.pi / 4)
    assert angular == pytest.approx(0.5)
    assert linear < 0.2


def test_what_lies_behind_is_turned_to_on_the_spot():
    assert pursue(PARAMS, Track(LINE), 0.5, 0.0, math.pi - 0.1) == (0.0, -0.5)


def test_it_slows_down_to_the_end_and_stands_there():
    assert pursue(PARAMS, Track(LINE), 1.9, 0.0, 0.0)[0] == pytest.approx(0.08)
    assert pursue(PARAMS, Track(LINE), 1.96, 0.0, 0.0) == (0.0, 0.0)


def test_a_path_that_crosses_itself_is_not_cut_short():
    eight = Track([(0.0, 0.0), (4.0, 0.0), (4.0, 2.0), (2.0, 2.0), (2.0, -2.0)])
    for i in range(21):
        s = eight.locate(i / 10, 0.0)
    assert s == pytest.approx(2.0)
    assert eight.locate(3.5, 1.9) > 5.0, "moved by hand: looked for anew"


def test_it_follows_a_corner_in_a_simulation():
    track, x, y, heading = Track([(0.0, 0.0), (1.5, 0.0), (1.5, 1.5)]), 0.0, 0.1, 0.2
    farthest = 0.0
    for _ in range(3000):
        linear, angular = pursue(PARAMS, track, x, y, heading)
        if linear == angular == 0:
            break
        heading += angular * 0.01
        x, y = x + linear * math.cos(heading) * 0.01, y + linear * math.sin(heading) * 0.01
        farthest = max(farthest, min(math.dist((x, y), track.at(s / 100)) for s in range(0, 301, 5)))
    assert math.dist((x, y), (1.5, 1.5)) < 0.1
    assert farthest < 0.25


@pytest.mark.parametrize("points", [[], [(0.0, 0.0)], [(1.0, 1.0), (1.0, 1.0)], [(0.0, 0.0), (math.nan, 1.0)]])
def test_a_path_that_is_none_is_refused(points):
    with pytest.raises(ValueError, match="path:"):
        Track(points)


@pytest.mark.parametrize("bad", [{"speed": 0.0}, {"lookahead": math.inf}, {"max_angular": -1.0}])
def test_parameters_that_lead_nowhere_are_refused(bad):
    with pytest.raises(ValueError, match=f"path: {next(iter(bad))} must be above 0"):
        PursuitParams(**bad)
