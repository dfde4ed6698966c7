from math import nan

import pytest

from skytether.control.admittance import Velocity
from skytether.messages import (
    Odometry,
    Path,
    Point,
    Pose,
    PoseStamped,
    PoseWithCovariance,
    Twist,
    quaternion_from_yaw,
)
from skytether.robot.control.fallback import Reading
from skytether.robot.control.follow_path import FollowPath

STILL = Velocity(0.0, 0.0)


def at(x, y=0.0, heading=0.0):
    pose = Pose(Point(x, y), quaternion_from_yaw(heading))
    return Reading(Odometry(pose=PoseWithCovariance(pose)), 4.0)


def path(*points):
    return Reading(Path(poses=tuple(PoseStamped(pose=Pose(Point(x, y))) for x, y in points)), 1.0)


def test_it_follows_the_points_of_the_configuration_by_odometry():
    fallback = FollowPath(points=[[0, 0], [2, 0]], speed=0.15)
    assert fallback.drives
    assert fallback.step(STILL, {"odom": at(0.5)}, 0.01) == (pytest.approx((0.15, 0.0)), 4.0)


def test_it_follows_the_newest_path_of_a_topic():
    fallback = FollowPath(path="plan")
    assert fallback.step(STILL, {"odom": at(0.5)}, 0.01) is None
    readings = {"odom": at(0.5), "plan": path((0.0, 0.0), (2.0, 0.0))}
    assert fallback.step(STILL, readings, 0.01)[0] == pytest.approx((0.2, 0.0))
    readings["plan"] = path((0.5, 0.0), (0.5, 2.0))
    assert fallback.step(STILL, readings, 0.01)[0].angular > 0
    readings["plan"] = path((0.5, nan), (0.5, 2.0))
    assert fallback.step(STILL, readings, 0.01) is None, "a path that is none"


@pytest.mark.parametrize("odom", [None, at(nan), Reading(Twist(), 4.0)])
def test_without_a_pose_it_says_nothing(odom):
    readings = {} if odom is None else {"odom": odom}
    assert FollowPath(points=[[0, 0], [2, 0]]).step(STILL, readings, 0.01) is None


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"points": [[0, 0]]}, "at least two points"),
        ({"points": [[0, 0], [1, 2, 3]]}, r"must be a pair \[x, y\]"),
        ({"speed": -1}, "speed must be above 0"),
    ],
)
def test_options_that_make_no_sense_are_refused(options, sentence):
    with pytest.raises(ValueError, match=sentence):
        FollowPath(**options)
