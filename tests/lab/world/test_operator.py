import itertools
import math

import numpy as np
import pytest

from skytether.lab.trail import Pose
from skytether.lab.world.gait import Gait
from skytether.lab.world.lemniscate import Lemniscate
from skytether.lab.world.operator import Figure, Operator, OperatorParams
from skytether.lab.world.plan import hall
from skytether.lab.world.robot import Motion, RearParams, RobotParams
from skytether.lab.world.simulation import TICK, Simulation
from skytether.messages import LaserScan, TFMessage, yaw_of

CURVE = Lemniscate()
STILL = Motion(0.0, 0.0, 0.0)
CALM = OperatorParams(speed_spread=0.0, wander=0.0)
REAR = RobotParams(rear=RearParams())


def ahead_of(robot: Pose, metres: float) -> Pose:
    return Pose(robot.x + metres * math.cos(robot.heading), robot.y + metres * math.sin(robot.heading), robot.heading)


def follow(operator: Operator, speed: float, seconds: float) -> list[tuple[Pose, Figure]]:
    """A robot that drives straight on from the beginning of the curve."""
    start, found = CURVE.at(0.0), []
    for tick in range(round(seconds / TICK)):
        robot = ahead_of(start, speed * tick * TICK)
        found.append((robot, operator.step(robot, Motion(speed, 0.0, 0.0), TICK)))
    return found


def test_a_foot_rests_while_the_other_swings() -> None:
    gait, pose = Gait(Pose(0, 0, 0)), Pose(0, 0, 0)
    feet = [gait.feet]
    for _ in range(800):
        pose = Pose(pose.x + 0.004, 0.0, 0.0)  # 0.4 m/s
        gait.step(pose, 0.004, TICK)
        feet.append(gait.feet)
    steps = np.linalg.norm(np.diff(np.array(feet), axis=0), axis=2)
    resting = steps == 0.0
    assert resting.any(axis=1).all()  # never both in the air
    assert resting[200:].mean(axis=0) == pytest.approx([0.6, 0.6], abs=0.05)
    assert steps.max() < 0.03  # no foot flies: 3 m/s
    ahead = np.array(feet)[200:, :, 0] - (0.004 * np.arange(201, 802) - 0.004)[:, None]
    # A step is 0.41 m, a foot rests for 1.2 of them: from 0.25 m before the body to 0.25 m behind it.
    assert ahead.max() == pytest.approx(0.25, abs=0.02)
    assert ahead.min() == pytest.approx(-0.25, abs=0.02)


def test_who_stops_puts_the_feet_together() -> None:
    gait, pose = Gait(Pose(0, 0, 0)), Pose(0, 0, 0)
    for _ in range(130):
        pose = Pose(pose.x + 0.004, 0.0, 0.0)
        gait.step(pose, 0.004, TICK)
    for _ in range(150):
        gait.step(pose, 0.0, TICK)
    assert np.array(gait.feet) == pytest.approx(np.array([(pose.x, 0.11), (pose.x, -0.11)]), abs=0.021)
    before = gait.feet
    gait.step(pose, 0.0, TICK)
    assert gait.feet == before


def test_walks_after_the_robot_at_a_speed_of_their_own_and_no_nearer_than_they_like() -> None:
    operator = Operator(CURVE, 1, CALM)
    walked = follow(operator, 0.3, 12.0)
    away = [math.dist(robot[:2], figure.stance.trunk) for robot, figure in walked]
    assert min(away) > CALM.near
    # Where they walk at 0.3 m/s of their 0.4: three quarters of the way from near to easy.
    assert away[-1] == pytest.approx(CALM.near + 0.75 * (CALM.easy - CALM.near), abs=0.02)
    speeds = {round(Operator(CURVE, seed).speed, 4) for seed in range(20)}
    assert len(speeds) == 20
    assert all(0.35 < speed < 0.45 for speed in speeds)


def test_who_stands_behind_a_robot_that_stands_comes_up_and_waits() -> None:
    operator = Operator(CURVE, 1, CALM)
    walked = follow(operator, 0.0, 5.0)
    assert math.dist(walked[-1][0][:2], walked[-1][1].stance.trunk) == pytest.approx(CALM.near, abs=0.05)
    assert walked[-1][1].stance == walked[-50][1].stance
    # Of a robot that stands they ask nothing.
    assert abs(operator.face_angle(walked[-1][0])) < 1e-6


def test_the_head_answers_after_the_reaction_time_turns_so_fast_and_so_far() -> None:
    operator = Operator(CURVE, 1, CALM)
    start = CURVE.at(0.0)
    for _ in range(100):
        operator.step(start, STILL, TICK)
    # It was carried to the right, and is fast: they want it back to the left.
    robot, moving = Pose(start.x - 0.6, start.y - 0.6, start.heading), Motion(0.6, 0.0, 0.0)
    angles = []
    for _ in range(200):
        operator.step(robot, moving, TICK)
        angles.append(operator.face_angle(robot))
    assert angles[23] == pytest.approx(0.0, abs=1e-9)
    assert angles[26] > 0.01
    assert max(np.diff(angles)) == pytest.approx(CALM.head_rate * TICK)
    assert angles[-1] == pytest.approx(CALM.widest)


def test_how_far_the_face_turns_is_what_the_robots_law_needs_for_the_curve() -> None:
    """On the curve, at 0.4 m/s, without a delay: a turn by the curvature 3 r / w^2 times the speed."""
    for s in (4.0, 4.6, 13.5):
        prompt = OperatorParams(wander=0.0, reaction=0.0, answer=0.0, head_rate=1000.0, speed_time=1e-6)
        operator = Operator(CURVE, 1, prompt)
        operator.lap.s = s
        robot = CURVE.at(s)
        operator.step(robot, Motion(0.4, 0.0, 0.0), TICK)
        middle = CURVE.at(s + 0.4)
        side = 1.0 if s < CURVE.length / 2 else -1.0
        turn = side * 0.4 * 3 * math.hypot(middle.x, middle.y) / CURVE.half_width**2
        angle = operator.face_angle(robot)
        assert prompt.gain * (angle - side * prompt.dead_band) == pytest.approx(turn, rel=0.05)


def test_same_seed_same_person_another_seed_another() -> None:
    def run(seed: int) -> list[Figure]:
        return [figure for _, figure in follow(Operator(CURVE, seed), 0.35, 3.0)]

    assert run(1) == run(1)
    assert run(1) != run(2)


def test_after_a_round_they_stand_and_look_straight_on() -> None:
    operator = Operator(CURVE, 1, CALM)
    for s in itertools.chain(np.arange(0.0, CURVE.length, 0.004), itertools.repeat(CURVE.length, 300)):
        robot = CURVE.at(min(s, CURVE.length - 1e-6))
        operator.step(robot, Motion(0.4 if s < CURVE.length else 0.0, 0.0, 0.0), TICK)
    assert operator.done
    before = operator.pose
    operator.step(robot, STILL, TICK)
    assert operator.pose == before
    assert abs(operator.face_angle(robot)) < 1e-6


def test_the_path_is_free_for_robot_and_operator() -> None:
    clearance = hall().clearance(CURVE.points)
    assert clearance.min() > RobotParams().circumscribed + 0.4
    assert hall().starts[0] == pytest.approx(CURVE.at(0.0), abs=1e-9)


def test_the_rear_laser_sees_the_legs_of_the_operator_behind() -> None:
    world = Simulation(hall(), seed=1, params=REAR, operator=Operator(CURVE, 1, CALM))
    ranges = world.robots[0].eyes.rear_ranges(world.robots[0].pose)
    # Both legs, 0.11 m aside and 0.06 m thick, 0.95 m behind the laser; between them the wall.
    angle = math.atan2(0.11, 0.95)
    for side in (1, -1):
        ray = 270 + round(side * math.degrees(angle) * 2)
        assert ranges[ray] == pytest.approx(math.hypot(0.95, 0.11) - 0.06, abs=2e-3)
    assert ranges[270] > 3.0


def test_what_a_robot_with_a_rear_laser_measures_and_what_one_without_measures_as_before() -> None:
    with_rear = Simulation(hall(), seed=1, params=REAR)
    without = Simulation(hall(), seed=1)
    for _ in range(30):
        mine, plain = with_rear.tick()[0], without.tick()[0]
        assert [message for topic, message in mine if topic not in ("rear_scan", "tf")] == [
            message for topic, message in plain if topic != "tf"
        ]
    found = dict(mine)
    while "rear_scan" not in found:
        found = dict(with_rear.tick()[0])
    scan, tf = found["rear_scan"], found["tf"]
    assert isinstance(scan, LaserScan)
    assert isinstance(tf, TFMessage)
    assert (len(scan.ranges), scan.header.frame_id, scan.scan_time) == (541, "rear_laser", 0.1)
    frames = {t.child_frame_id: t.transform for t in tf.transforms}
    assert list(frames) == ["base_link", "laser", "rear_laser", "camera"]
    assert abs(yaw_of(frames["rear_laser"].rotation)) == pytest.approx(math.pi)
    # The camera's axis, x in its frame: (1 - 2 (y^2 + z^2), 2 (x y + z w), 2 (x z - y w)) of the quaternion.
    q = frames["camera"].rotation
    axis = (1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y + q.z * q.w), 2 * (q.x * q.z - q.y * q.w))
    up = REAR.rear.camera_up
    assert axis == pytest.approx((-math.cos(up), 0.0, math.sin(up)))
    topics = with_rear.robots[0].topics(REAR)
    assert {name for name in topics if name not in without.robots[0].topics()} == {"rear_scan", "camera/compressed"}
    with pytest.raises(ValueError, match="no laser that looks back"):
        without.robots[0].eyes.rear_ranges(without.robots[0].pose)
