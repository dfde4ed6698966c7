import math
from math import inf

import numpy as np
import pytest

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.robot.control.supervisor import VelocityLimits
from skytether.robot.safety.geometry.dead_reckoning import Variation
from skytether.robot.safety.geometry.footprint import polygon
from skytether.robot.safety.geometry.stopping import Stages
from skytether.robot.safety.rules.zones import Zone, ZoneParams, Zones

# A square of 1 m; room of 0.1 m; braking 2 m/s^2 and 4 rad/s^2.
SQUARE = polygon([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
PARAMS = ZoneParams(stop_m=0.1, slow_m=0.5, slow_speed=0.1, hysteresis_m=0.05)
FAST = VelocityLimits(linear_max=2.0, linear_min=-2.0, angular_max=2.0)
# All stages together: 0.1 s.
STAGES = Stages(sensing_s=0.0, period_s=0.01, guard_s=0.05, writer_s=0.0, wheels_s=0.03)
STEADY = Variation(0.0, 0.0)
ZONES = Zones(PARAMS, SQUARE, FAST, STAGES)


def ahead(way: float) -> np.ndarray:
    """Something that much way before the stop zone, straight on."""
    return np.array([[0.6 + way, 0.0]])


def test_far_away_everything_is_allowed():
    found = ZONES.allow(Velocity(0.25, 0.0), ahead(5.0), STEADY, Zone.CLEAR)
    assert (found.share, found.zone, found.way) == (1.0, Zone.CLEAR, inf)
    assert ZONES.allow(Velocity(0.25, 0.0), np.empty((0, 2)), STEADY, Zone.SLOW).zone is Zone.CLEAR


def test_the_speed_is_one_from_which_the_robot_stops_in_time():
    # Wanted 2 m/s, 0.6 m free: v r + v^2 / (2 a) = 0.6 with r = 0.1 s and a = 2 m/s^2 has v = -0.2 + sqrt(0.04 + 2.4).
    found = ZONES.allow(Velocity(2.0, 0.0), ahead(0.6), STEADY, Zone.CLEAR)
    assert found.zone is Zone.CLEAR
    assert found.way == pytest.approx(0.6)
    assert 2.0 * found.share == pytest.approx(-0.2 + math.sqrt(2.44))


def test_where_the_robot_may_not_be_where_it_is_thought_to_be_there_is_more_room():
    # 0.4 m/s slower than it was, and the wheels may be 0.03 s late: 12 mm.
    found = ZONES.allow(Velocity(2.0, 0.0), ahead(0.6), Variation(0.4, 0.0), Zone.CLEAR)
    assert found.way == pytest.approx(0.588)
    assert 2.0 * found.share == pytest.approx(-0.2 + math.sqrt(0.04 + 4 * 0.588))


def test_the_slow_zone_has_a_speed():
    found = ZONES.allow(Velocity(0.25, 0.0), ahead(0.4), STEADY, Zone.CLEAR)
    assert found.zone is Zone.SLOW
    assert 0.25 * found.share == pytest.approx(0.1)
    # For turning on the spot the speed is that of the corner, 0.707 m away.
    assert ZONES.slow(Velocity(0.0, 1.0)) == pytest.approx(0.1 / math.sqrt(0.5))
    assert ZONES.slow(Velocity(0.05, 0.0)) == 1.0
    assert ZONES.slow(STANDSTILL) == 1.0


def test_the_stop_zone_stops_what_comes_nearer_and_lets_go_what_does_not():
    inside = ahead(-0.02)
    assert ZONES.allow(Velocity(0.25, 0.0), inside, STEADY, Zone.CLEAR).share == 0.0
    assert ZONES.allow(Velocity(0.25, 0.0), inside, STEADY, Zone.CLEAR).zone is Zone.STOP
    assert ZONES.allow(Velocity(-0.25, 0.0), inside, STEADY, Zone.STOP).share == 1.0


def test_zones_are_left_later_than_they_are_entered():
    slowly = Velocity(0.02, 0.0)
    assert ZONES.allow(slowly, ahead(0.04), STEADY, Zone.SLOW).zone is Zone.SLOW
    assert ZONES.allow(slowly, ahead(0.04), STEADY, Zone.STOP).zone is Zone.STOP
    assert ZONES.allow(slowly, ahead(0.06), STEADY, Zone.STOP).zone is Zone.SLOW
    assert ZONES.allow(slowly, ahead(0.54), STEADY, Zone.SLOW).zone is Zone.SLOW
    assert ZONES.allow(slowly, ahead(0.54), STEADY, Zone.CLEAR).zone is Zone.CLEAR
    assert ZONES.allow(slowly, ahead(0.56), STEADY, Zone.SLOW).zone is Zone.CLEAR


def test_whoever_stands_still_says_nothing_about_the_zones():
    found = ZONES.allow(STANDSTILL, ahead(-0.05), STEADY, Zone.STOP)
    assert (found.share, found.zone) == (1.0, Zone.STOP)


@pytest.mark.parametrize("name", ["stop_m", "slow_m", "slow_speed", "hysteresis_m", "reaction_s"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, inf])
def test_zones_that_would_not_stop_are_refused(name, value):
    with pytest.raises(ValueError, match=f"zones: {name} must be above 0"):
        ZoneParams(**{name: value})


def test_the_end_of_what_is_seen_counts_as_something_that_stands_there():
    # 0.6 m to the end of sight: as for a wall there, but without a zone.
    share = ZONES.within_sight(Velocity(2.0, 0.0), ahead(0.6), STEADY)
    assert 2.0 * share == pytest.approx(-0.2 + math.sqrt(2.44))
    assert ZONES.within_sight(Velocity(2.0, 0.0), ahead(5.0), STEADY) == 1.0
    assert ZONES.within_sight(STANDSTILL, ahead(0.1), STEADY) == 1.0
