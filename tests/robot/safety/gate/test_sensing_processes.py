"""Guard and gate as real processes: presses while the gate hangs or dies, bumpers, lasers that do not see."""

import signal
import socket
from collections.abc import Callable

import numpy as np
import pytest

from skytether.guard.velocity import STANDSTILL
from skytether.lab.safety.robot import RAYS, PlayedRobot, scan_of
from skytether.messages import Bool, encode

pytestmark = pytest.mark.slow

QUIET_BUTTON = {"estop": {"max_age_s": None}, "guard_s": 0.5, "limits": {"max_gap_s": 0.5, "linear_max": 0.5}}


@pytest.fixture
def play(tmp_path):
    robots = []

    def start(safety=None) -> PlayedRobot:
        robots.append(PlayedRobot(tmp_path, safety))
        return robots[-1]

    yield start
    for robot in robots:
        robot.close()


def press(robot: PlayedRobot, topic: str, value: bool) -> None:
    """A driver's word, on a socket of its own."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.sendto(topic.encode() + b"\0" + encode(Bool(data=value)), str(robot.folder / "estop.sock"))


def stands(robot: PlayedRobot) -> None:
    robot.wait(lambda: robot.velocity == STANDSTILL, "the robot stands")


def stopped(robot: PlayedRobot) -> str:
    said: list[str] = []

    def is_stopped() -> bool:
        said.append(robot.ask("status")["stopped"])
        return bool(said[-1])

    robot.wait(is_stopped, "the stop is latched", 0.1)
    return said[-1]


def test_a_press_during_a_stall_is_not_lost_behind_hundreds_of_scans(play):
    robot = play(QUIET_BUTTON)
    robot.go()
    robot.pressed = None  # it speaks only when it changes
    gate = robot.pid("gate")
    robot.kill(gate, signal.SIGSTOP)
    for _ in range(300):
        robot.hardware.send("scan", robot.clear())
    press(robot, "estop", True)
    press(robot, "estop", False)  # it was let go again
    for _ in range(300):
        robot.hardware.send("scan", robot.clear())
    robot.kill(gate, signal.SIGCONT)
    assert "button was pressed" in stopped(robot)
    stands(robot)


def test_a_press_that_waits_while_the_gate_dies_is_taken_by_the_next(play):
    robot = play(QUIET_BUTTON)
    robot.go()
    robot.pressed = None
    gate = robot.pid("gate")
    robot.kill(gate, signal.SIGSTOP)
    press(robot, "estop", True)
    press(robot, "estop", False)
    robot.kill(gate)
    robot.another_gate(gate)
    assert "button was pressed" in stopped(robot)
    stands(robot)


def test_a_bumper_is_latched_and_named(play):
    robot = play({"contacts": {"bumper_left": {"max_age_s": None}}})
    robot.wait(lambda: (robot.folder / "estop.sock").exists(), "the guard listens")
    press(robot, "bumper_left", False)
    robot.go()
    press(robot, "bumper_left", True)
    press(robot, "bumper_left", False)
    stands(robot)
    assert stopped(robot) == "the bumper bumper_left was touched"
    robot.go()


BLIND: dict[str, Callable[[], object]] = {
    "too close": lambda: scan_of(np.full(RAYS, -np.inf, dtype=np.float32)),
    "minus one": lambda: scan_of(np.full(RAYS, -1, dtype=np.float32)),
    "one ray backwards": lambda: scan_of(np.full(1, 5, dtype=np.float32)),
    "four rays": lambda: scan_of(np.full(4, 5, dtype=np.float32), np.pi / 2),
    "a wall, and the middle is missing": lambda: scan_of(
        np.where(np.abs(np.arange(RAYS) - 180) < 60, np.nan, 5).astype(np.float32)
    ),
}


def test_lasers_that_do_not_see_are_unknown_and_stop_the_robot(play):
    robot = play()
    robot.go()
    for name, scan in BLIND.items():
        robot.scan = scan
        stands(robot)
        status = robot.ask("status")
        assert status["zone"] in ("unknown", "stop"), name
        assert any(sentence.startswith("scan: is ") for sentence in status["troubles"]), name
        robot.scan = robot.clear
        robot.go()


def test_a_laser_that_is_late_from_its_first_scan_is_stale_by_the_robots_own_clock(play):
    robot = play({"sensors": {"scan": {"max_age_s": 0.3, "stamps": "own"}}})
    robot.go()
    robot.scan = lambda: None
    stands(robot)
    robot.reset()  # the gate learns anew what is usual of each sensor
    robot.scan = lambda: scan_of(np.full(RAYS, 5, dtype=np.float32), age_s=0.5)
    robot.wait(lambda: any("by its stamp it came 0.5 s late" in said for said in robot.ask("status")["troubles"]), "it")
    robot.start()
    stands(robot)
    robot.scan = robot.clear
    robot.go()


def test_two_old_scans_that_take_turns_are_silence(play):
    robot = play()
    robot.go()
    old = [scan_of(np.full(RAYS, 5, dtype=np.float32), age_s=age) for age in (2.0, 1.0)]
    robot.scan = lambda: old.append(old.pop(0)) or old[0]
    stands(robot)
    assert robot.ask("status")["zone"] == "unknown"
    robot.scan = robot.clear
    robot.go()
