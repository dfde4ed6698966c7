"""The track of dead reckoning: where the robot was, and what becomes of a jump."""

import math

import pytest

from skytether_services.planar.geometry import Pose
from skytether_services.planar.odometry_track import KEPT, OdometryTrack, Reach

REACH = Reach(1.0, 2.0, 0.1, 0.2)


def test_between_two_samples_the_way_is_straight() -> None:
    track = OdometryTrack(REACH)
    track.add(10.0, Pose(0.0, 0.0, 3.1), 0.0)
    track.add(10.2, Pose(0.2, 0.1, -3.1), 0.2)
    # A quarter of the way; the heading goes over pi, 0.083 rad in all.
    assert track.pose_at(10.05) == pytest.approx(Pose(0.05, 0.025, 3.1 + (math.tau - 6.2) / 4))
    assert track.pose_at(9.9) is None
    assert track.pose_at(10.3) is None


def test_a_jump_is_told_and_taken_out() -> None:
    track = OdometryTrack(REACH)
    assert not track.add(0.0, Pose(1.0, 0.0, 0.0), 0.0)
    assert track.add(0.1, Pose(9.0, 5.0, math.pi / 2), 0.1)
    assert track.newest.pose == pytest.approx(Pose(1.0, 0.0, 0.0))
    # The next 0.1 m forward are forward: along the jumped heading, which was the x axis.
    assert not track.add(0.2, Pose(9.0, 5.1, math.pi / 2), 0.2)
    assert track.newest.pose == pytest.approx(Pose(1.1, 0.0, 0.0))


def test_a_way_that_a_gap_explains_is_no_jump() -> None:
    track = OdometryTrack(REACH)
    track.add(0.0, Pose(0.0, 0.0, 0.0), 0.0)
    assert not track.add(0.9, Pose(0.9, 0.0, 0.0), 0.9)
    assert track.add(60.0, Pose(30.0, 0.0, 0.0), 60.0)


def test_what_is_old_or_not_finite_is_left_out() -> None:
    track = OdometryTrack(REACH)
    track.add(1.0, Pose(0.0, 0.0, 0.0), 1.0)
    track.add(0.9, Pose(5.0, 0.0, 0.0), 1.0)
    track.add(1.1, Pose(math.nan, 0.0, 0.0), 1.1)
    assert track.newest.stamp == 1.0


def test_a_clock_that_was_set_back_begins_anew() -> None:
    track = OdometryTrack(REACH)
    track.add(100.0, Pose(2.0, 0.0, 0.0), 5.0)
    assert not track.add(3.0, Pose(2.05, 0.0, 0.0), 5.1)
    assert track.newest.pose == pytest.approx(Pose(2.05, 0.0, 0.0))


def test_it_keeps_no_more_than_it_needs() -> None:
    track = OdometryTrack(REACH)
    for tick in range(KEPT + 50):
        track.add(tick / 100, Pose(0.0, 0.0, 0.0), tick / 100)
    assert track.pose_at(0.49) is None
    assert track.pose_at(0.5) is not None
