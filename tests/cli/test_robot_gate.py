"""The gate of ``robot run``: one that was found, and ends."""

from types import SimpleNamespace

import pytest

from skytether.cli.robot_gate import FoundGate


class Own:
    def __init__(self, config, safety, *, assumed):
        self.assumed, self.closed = assumed, False

    def look(self):
        return "own"

    def close(self):
        self.closed = True


class Robot:
    def __init__(self):
        self.now, self.there, self.made = 100.0, True, []
        self.gate = FoundGate(
            "robot.yaml",
            SimpleNamespace(place=lambda: "run"),
            assumed=True,
            make=self.make,
            there=lambda folder: self.there,
            clock=lambda: self.now,
        )

    def make(self, *arguments, **more):
        self.made.append(Own(*arguments, **more))
        return self.made[-1]

    def look(self, seconds):
        for _ in range(round(seconds / 0.5)):
            self.now += 0.5
            said = self.gate.look()
        return said


@pytest.fixture
def robot():
    return Robot()


def test_the_gate_of_an_agent_that_was_killed_is_followed_by_one_of_our_own(robot):
    robot.look(3.0)
    robot.there = False
    robot.look(1.0)
    assert not robot.made, "it may be started anew"
    robot.look(0.5)
    assert robot.made[0].assumed
    assert robot.look(0.5) == "own"
    robot.gate.close()
    assert robot.made[0].closed


def test_a_gate_that_is_started_anew_or_ended_later_is_left_alone(robot):
    robot.there = False
    robot.look(1.0)
    robot.there = True
    robot.look(20.0)
    robot.there = False
    assert robot.look(60.0) == ""
    robot.gate.close()
    assert not robot.made
