import importlib.util
import math
import sys

import numpy as np
import pytest

from skytether.lab.trail import Pose
from skytether.lab.world.contacts import Judge, Touched
from skytether.lab.world.model import WorldError
from skytether.lab.world.plan import Box, Cylinder, Plan, Walk, building
from skytether.lab.world.simulation import TICK, Simulation
from skytether.messages import LaserScan, Odometry, Range, TFMessage, Twist, Vector3, yaw_of

HERE = Pose(0.0, 0.0, 0.0)


def room(*walks: Walk, cylinders: tuple[Cylinder, ...] = (), starts: tuple[Pose, ...] = (HERE,)) -> Plan:
    """A room of 10 by 6 m between the inner sides of its walls, its middle at the origin."""
    walls = (
        Box("east", 5.5, 0.0, 1.0, 8.0, wall=True),
        Box("west", -5.5, 0.0, 1.0, 8.0, wall=True),
        Box("north", 0.0, 3.5, 12.0, 1.0, wall=True),
        Box("south", 0.0, -3.5, 12.0, 1.0, wall=True),
    )
    return Plan("room", walls, cylinders, starts, (HERE,), walks)


def drive(world: Simulation, linear: float, angular: float, seconds: float) -> None:
    for _ in range(round(seconds / TICK)):
        world.robots[0].write(Twist(Vector3(x=linear), Vector3(z=angular)))
        world.tick()


def test_the_building_compiles_and_its_laser_sees_the_walls() -> None:
    world = Simulation(building(), seed=1, robots=4, rounds=4)
    assert len(world.people) == 5
    # Robot 0 stands at (1.1, 1.1); its laser is 0.2 m before it. Walls are 0.12 m thick about their lines.
    ranges = world.robots[0].eyes.ranges(world.robots[0].pose)
    assert ranges[90] == pytest.approx(1.1 - 0.06)  # 90 degrees to the right


def test_laser_ranges_against_geometry() -> None:
    robot = Simulation(room(cylinders=(Cylinder("pole", 3.0, 0.0, 0.25),)), seed=1).robots[0]
    ranges = robot.eyes.ranges(HERE)
    angles = np.radians(np.arange(541) / 2 - 135)
    x, y = 0.2, 0.0
    with np.errstate(divide="ignore"):
        walls = np.minimum(
            np.where(np.cos(angles) > 0, 5.0 - x, 5.0 + x) / np.abs(np.cos(angles)), 3.0 / np.abs(np.sin(angles))
        )
    # Nearest point of a circle along a ray: s = b - sqrt(b^2 - c), b along the ray, c = |m|^2 - r^2.
    b = (3.0 - x) * np.cos(angles) - y * np.sin(angles)
    root = b**2 - ((3.0 - x) ** 2 - 0.25**2)
    pole = np.where((root >= 0) & (b > 0), b - np.sqrt(np.maximum(root, 0.0)), np.inf)
    assert ranges == pytest.approx(np.minimum(walls, pole), abs=1e-6)


def test_what_a_robot_measures_in_a_second() -> None:
    world = Simulation(room(), seed=1)
    found = [entry for _ in range(120) for entry in world.tick(now=100.0)[0]]
    counts = {topic: sum(t == topic for t, _ in found) for topic, _ in found}
    assert counts == {"tf": 120, "odom": 12, "scan": 10, **{f"sonar_{i}": 12 for i in range(4)}}
    assert {topic: type(message) for topic, message in found} == world.robots[0].topics()
    message = dict(found)
    scan, odom, tf, sonar = (message[name] for name in ("scan", "odom", "tf", "sonar_0"))
    assert isinstance(scan, LaserScan)
    assert (len(scan.ranges), scan.header.frame_id, scan.header.stamp.sec) == (541, "laser", 100)
    assert scan.angle_min + 540 * scan.angle_increment == pytest.approx(math.radians(135))
    assert isinstance(odom, Odometry)
    assert (odom.header.frame_id, odom.child_frame_id) == ("odom", "base_link")
    assert isinstance(tf, TFMessage)
    assert [t.child_frame_id for t in tf.transforms] == ["base_link", "laser"]
    assert isinstance(sonar, Range)
    # 20 degrees to the left, 0.35 m before the middle: the eastern wall is nearest at the cone's edge (7.5 degrees).
    assert sonar.range == pytest.approx((5.0 - 0.35) / math.cos(math.radians(7.5)), abs=0.1)


def test_laser_noise_is_as_said() -> None:
    world = Simulation(room(), seed=3)
    truth = world.robots[0].eyes.ranges(HERE)
    scans = [m.ranges for _ in range(240) for t, m in world.tick()[0] if t == "scan" and isinstance(m, LaserScan)]
    error = np.array(scans) - truth
    lost = np.isinf(error)
    assert lost.mean() == pytest.approx(0.002, abs=0.001)
    assert error[~lost].std() == pytest.approx(0.01, rel=0.05)


def test_it_drives_as_commanded_and_stands_when_nobody_commands() -> None:
    world = Simulation(room(starts=(Pose(-4.0, 0.0, 0.0),)), seed=1)
    robot = world.robots[0]
    drive(world, 0.5, 0.0, 4.0)
    # 0.5 m/s at 1 m/s^2: 0.125 m are lost in the ramp, and 0.025 m behind it (50 ms).
    assert robot.pose.x == pytest.approx(-4.0 + 2.0 - 0.15, abs=0.01)
    assert robot.motion.forward == pytest.approx(0.5, abs=1e-3)
    drive(world, 0.0, 0.5, 3.0)
    assert robot.motion.turning == pytest.approx(0.5, abs=1e-3)
    for _ in range(150):
        world.tick()
    assert robot.motion == pytest.approx((0, 0, 0), abs=1e-3)
    assert not world.contacts


def test_a_velocity_that_is_no_number_is_a_standstill() -> None:
    world = Simulation(room(), seed=1)
    drive(world, math.nan, math.inf, 0.5)
    assert world.robots[0].pose == pytest.approx(HERE)


def test_odometry_errs_by_its_seed_and_a_little() -> None:
    def ends(seed: int) -> tuple[Pose, Pose]:
        world = Simulation(room(), seed=seed)
        drive(world, 0.4, 0.5, 6.0)
        return world.robots[0].odometer.pose, world.robots[0].pose

    (told, truth), (other, same_truth) = ends(1), ends(2)
    assert truth == same_truth
    assert told != other
    assert ends(1)[0] == told
    for pose in (told, other):
        assert 1e-4 < math.dist(pose[:2], truth[:2]) < 0.3


def test_same_seed_same_world() -> None:
    def run() -> list[object]:
        world = Simulation(building(), seed=5, rounds=2)
        found: list[object] = []
        for _ in range(50):
            world.robots[0].write(Twist(Vector3(x=0.4), Vector3(z=0.1)))
            found += world.tick()[0]
        return found

    assert run() == run()


def test_a_wall_that_is_driven_into_is_one_contact_and_stops_the_robot() -> None:
    world = Simulation(room(starts=(Pose(4.0, 0.0, 0.0),)), seed=1)
    drive(world, 0.5, 0.0, 4.0)
    assert [(c.robot, c.kind, c.name) for c in world.contacts] == [(0, Touched.WALL, "east")]
    contact = world.contacts[0]
    # 0.65 m to the wall, 0.15 m lost at the start: 1.6 s.
    assert contact.began == pytest.approx(1.6, abs=0.05)
    assert contact.ended == pytest.approx(4.0, abs=0.02)
    assert contact.force > 50
    assert contact.x == pytest.approx(5.0, abs=0.05)
    assert world.robots[0].pose.x < 4.67
    # Its wheels stand as well: odometry does not run away.
    assert world.robots[0].odometer.pose.x < 0.75


def test_a_person_who_stands_is_a_contact_with_a_person() -> None:
    walk = Walk("anna", ((2.0, 0.05), (2.0, 2.0)), 1.0, after=(50.0, 0.0, 0.1))
    world = Simulation(room(walk), seed=1)
    drive(world, 0.5, 0.0, 4.0)
    assert {(c.kind, c.name) for c in world.contacts} == {(Touched.PERSON, "anna")}


def test_robots_see_and_touch_each_other() -> None:
    world = Simulation(room(starts=(HERE, Pose(2.0, 0.0, math.pi))), seed=1, robots=2)
    ranges = world.robots[0].eyes.ranges(HERE)
    assert ranges[270] == pytest.approx(2.0 - 0.35 - 0.2)
    drive(world, 0.5, 0.0, 4.0)
    assert {(c.robot, c.kind, c.name) for c in world.contacts} == {
        (0, Touched.ROBOT, "robot-1"),
        (1, Touched.ROBOT, "robot-0"),
    }


def test_a_robot_that_is_lifted_and_put_elsewhere_does_not_know_it() -> None:
    world = Simulation(room(), seed=1)
    drive(world, 0.5, 0.0, 1.0)
    before = world.robots[0].odometer.pose
    world.place(0, Pose(-3.0, 1.0, 1.0))
    world.tick()
    assert world.robots[0].pose == pytest.approx((-3.0, 1.0, 1.0), abs=0.01)
    assert math.dist(world.robots[0].odometer.pose[:2], before[:2]) < 0.02


def test_the_person_steps_in_after_the_first_goal() -> None:
    world = Simulation(building(), seed=1)
    person = world.people[0]
    drive(world, 0.0, 0.0, 0.2)
    assert not person.begun
    world.place(0, Pose(4.9, 1.0, 0.0))
    drive(world, 0.0, 0.0, 4.0)
    assert person.pose.y == pytest.approx(1.1)
    # In the way: the laser sees a leg between goals 1 and 2, 0.11 m beside the person's middle and 0.06 m thick.
    scan = world.robots[0].scan
    assert scan is not None
    assert scan.ranges[260:281].min() == pytest.approx(7.3 - 0.11 - 0.06 - 5.1, abs=0.06)
    drive(world, 0.0, 0.0, 6.0)
    assert person.done
    assert not world.contacts


def test_a_heading_turns_in_the_odometry_message() -> None:
    world = Simulation(room(), seed=1)
    drive(world, 0.0, 1.0, 2.0)
    odom = [m for _ in range(10) for t, m in world.tick()[0] if isinstance(m, Odometry)][-1]
    assert yaw_of(odom.pose.pose.orientation) == pytest.approx(world.robots[0].pose.heading, abs=0.2)


def test_touches_are_joined_to_contacts() -> None:
    judge = Judge()
    for at in (1.0, 1.2, 1.6, 3.0):
        judge.touch(0, Touched.WALL, "east", at, 1.0, 2.0, at)
    judge.touch(0, Touched.WALL, "west", 1.0, 1.0, 2.0, 5.0)
    assert [(c.name, c.began, c.ended, c.force) for c in judge.contacts] == [
        ("east", 1.0, 1.6, 1.6),
        ("east", 3.0, 3.0, 3.0),
        ("west", 1.0, 1.0, 5.0),
    ]


def test_too_many_are_refused() -> None:
    with pytest.raises(WorldError, match="places for 1 to 4 robots, not for 5"):
        Simulation(building(), seed=1, robots=5)
    with pytest.raises(WorldError, match="0 to 4 more people, not for 9"):
        Simulation(building(), seed=1, rounds=9)


def test_without_mujoco_it_says_what_to_install(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(WorldError, match=r"pip install 'skytether\[lab\]'"):
        Simulation(building(), seed=1)
    assert importlib.util.find_spec("skytether.lab.world.simulation") is not None
