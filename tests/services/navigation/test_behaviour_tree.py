"""Behaviour trees from files: what they do, and what is said of those that are wrong."""

from pathlib import Path

import pytest
from py_trees.common import Status

from skytether.control.admittance import Velocity
from skytether.service import ConfigError
from skytether_services.navigation.behaviour_tree import BUILT_IN, MAX_NODES, load_tree
from skytether_services.navigation.status import Code, Trouble
from skytether_services.planar.geometry import Pose


class FakeRobot:
    """Does what it is told at once; what was done is in `done`."""

    def __init__(self) -> None:
        self.now = 0.0
        self.pose = Pose(0.0, 0.0, 0.0)
        self.plan_age = float("inf")
        self.is_blocked = self.reached = self.walled_in = self.stuck = False
        self.no_path: Trouble | None = None
        self.blamed: Trouble | None = None
        self.done: list[str] = []

    def plan(self) -> Trouble | None:
        self.done.append("plan")
        self.plan_age = 0.0
        return self.no_path

    def follow(self) -> bool:
        self.done.append("follow")
        return self.reached

    def is_stuck(self) -> bool:
        return self.stuck

    def clear(self, *, whole: bool, near: bool) -> None:
        self.done.append(f"clear {whole} {near}")

    def creep(self, velocity: Velocity, ahead: float) -> bool:
        self.done.append(f"creep {velocity.linear:g} {velocity.angular:g}")
        return not self.walled_in

    def turn_rate(self, left: float, most: float) -> float:
        return most if left > 0 else -most

    def blame(self, trouble: Trouble) -> None:
        self.blamed = trouble

    def recovered(self) -> None:
        self.done.append("recover")
        self.plan_age = float("inf")

    def wait(self, seconds: float) -> None:
        self.now += seconds
        self.plan_age += seconds


@pytest.fixture
def robot() -> FakeRobot:
    return FakeRobot()


def tree_of(tmp_path: Path, robot: FakeRobot, text: str):
    path = tmp_path / "tree.yaml"
    path.write_text(text)
    return load_tree(path, robot, 1.0)


def test_the_built_in_tree_plans_follows_and_arrives(robot: FakeRobot) -> None:
    tree = load_tree(BUILT_IN, robot, 1.0)
    tree.tick_once()
    robot.wait(0.5)
    tree.tick_once()
    robot.wait(0.6)
    tree.tick_once()
    # Anew after a second.
    assert robot.done == ["plan", "follow", "follow", "plan", "follow"]
    robot.reached = True
    tree.tick_once()
    assert tree.status is Status.SUCCESS


def test_something_in_the_way_is_planned_around_at_once(robot: FakeRobot) -> None:
    tree = load_tree(BUILT_IN, robot, 1.0)
    tree.tick_once()
    robot.is_blocked = True
    robot.wait(0.4)
    tree.tick_once()
    assert robot.done == ["plan", "follow", "plan", "follow"]


def test_it_recovers_by_turns_and_gives_up_with_the_last_reason(robot: FakeRobot) -> None:
    robot.no_path = Trouble(Code.NO_PATH, "No path.")
    tree = load_tree(BUILT_IN, robot, 1.0)
    for _ in range(2000):
        tree.tick_once()
        if tree.status is not Status.RUNNING:
            break
        robot.wait(0.1)
        robot.pose = Pose(robot.pose.x - 0.02, 0.0, robot.pose.yaw + 0.05)
    assert tree.status is Status.FAILURE
    assert robot.blamed == robot.no_path
    acts = [act for act in robot.done if not act.startswith("creep")]
    # The seventh time there is no recovery left.
    assert acts.count("plan") == 7
    assert acts[:7] == ["plan", "recover", "clear True True", "plan", "recover", "plan", "recover"]
    assert "creep 0 0.6" in robot.done
    assert "creep -0.1 0" in robot.done


def test_a_way_that_stays_blocked_fails_after_its_patience(tmp_path: Path, robot: FakeRobot) -> None:
    tree = tree_of(tmp_path, robot, "follow: {patience: 2}")
    robot.is_blocked = True
    tree.tick_once()
    robot.wait(1.9)
    tree.tick_once()
    assert tree.status is Status.RUNNING
    robot.wait(0.2)
    tree.tick_once()
    assert (tree.status, robot.blamed.code) == (Status.FAILURE, Code.BLOCKED)


def test_a_robot_that_does_not_get_on_fails(tmp_path: Path, robot: FakeRobot) -> None:
    robot.stuck = True
    tree = tree_of(tmp_path, robot, "follow")
    tree.tick_once()
    assert (tree.status, robot.blamed.code) == (Status.FAILURE, Code.STUCK)


@pytest.mark.parametrize("leaf", ["rotate: {angle: 1.0}", "back_up: {distance: 1.0}"])
def test_a_movement_into_something_fails(tmp_path: Path, robot: FakeRobot, leaf: str) -> None:
    robot.walled_in = True
    tree = tree_of(tmp_path, robot, leaf)
    tree.tick_once()
    assert tree.status is Status.FAILURE


def test_a_turn_ends_at_its_angle(tmp_path: Path, robot: FakeRobot) -> None:
    tree = tree_of(tmp_path, robot, "rotate: {angle: -7.0}")
    for _ in range(68):
        tree.tick_once()
        robot.pose = Pose(0.0, 0.0, robot.pose.yaw - 0.1)
    assert tree.status is Status.RUNNING
    robot.pose = Pose(0.0, 0.0, robot.pose.yaw - 0.2)
    tree.tick_once()
    assert tree.status is Status.SUCCESS


def test_time_limits_and_retries(tmp_path: Path, robot: FakeRobot) -> None:
    text = "retry: {times: 2, child: {timeout: {seconds: 1, child: {wait: {seconds: 5}}}}}"
    tree = tree_of(tmp_path, robot, text)
    seen = []
    for _ in range(4):
        tree.tick_once()
        seen.append(tree.status)
        robot.wait(1.1)
    # Twice, each to its limit.
    assert seen == [Status.RUNNING, Status.RUNNING, Status.RUNNING, Status.FAILURE]


def test_a_round_robin_fails_when_all_have_failed(tmp_path: Path, robot: FakeRobot) -> None:
    tree = tree_of(tmp_path, robot, "round_robin: [give_up, {give_up: {code: late, message: Too late.}}]")
    tree.tick_once()
    assert tree.status is Status.FAILURE
    assert robot.blamed == Trouble("late", "Too late.")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("fallback:\n  - follow\n  - rotat: {angle: 1}", "line 3: there is no node 'rotat'; did you mean rotate?"),
        ("sequence:\n  - wait: {second: 1}", "line 2: wait: there is no parameter 'second'; there are seconds"),
        ("sequence:\n  - wait: {seconds: soon}", "line 2: wait: parameter 'seconds': .*number, not \"soon\""),
        ("sequence:\n  - wait: {seconds: 2026-01-01}", "line 2: wait: .*JSON"),
        ("sequence: follow", "line 1: sequence needs a list of nodes"),
        ("sequence: []", "line 1: sequence needs a list of nodes"),
        ("retry: {times: 2}", "line 1: retry needs 'child', a node"),
        ("recover: {times: 2, do: follow}", "line 1: recover needs 'by', a node"),
        ("recover: {do: follow, by: wait}", "line 1: recover: parameter 'times' is missing"),
        ("retry: follow", "line 1: retry needs child and its parameters"),
        ("plan: follow", "line 1: plan needs its parameters, as 'name: value'"),
        ("- plan\n- follow", "line 1: write one node here"),
        ("plan: {}\nfollow: {}", "line 1: write one node here"),
        ("", "is empty; write a node"),
        ("sequence: [plan, follow", "line 1: "),
        ("sequence: [" * 400, "."),
        ("&a [*a]", "write one node here"),
        ("sequence: &a [sequence: *a]", f"more than {MAX_NODES} nodes"),
    ],
)
def test_a_wrong_file_is_told_with_its_line(tmp_path: Path, robot: FakeRobot, text: str, said: str) -> None:
    with pytest.raises(ConfigError, match=f"^behaviours: .*tree.yaml.*{said}"):
        tree_of(tmp_path, robot, text)


def test_a_file_that_is_not_there_is_told(tmp_path: Path, robot: FakeRobot) -> None:
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        load_tree(tmp_path / "none.yaml", robot, 1.0)
