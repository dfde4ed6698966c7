"""A robot whose wheels are on another computer than its gate, and the network between the two is cut: real ROS 2."""

import os
import signal
import subprocess
import time
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import pytest
from networks import cable

from skytether.guard.clock import now
from skytether.guard.velocity import STANDSTILL
from skytether.lab.netns import Namespace
from skytether.lab.safety.robot import PlayedRobot
from skytether.lab.safety.ros2_hardware import Ros2Hardware
from skytether.lab.safety.stage import Stage

pytestmark = [pytest.mark.slow, pytest.mark.ros2, pytest.mark.usefixtures("netns")]
UNHURRIED = {"rate_hz": 20, "guard_s": 0.4, "limits": {"linear_max": 0.5, "angular_max": 0.8, "max_gap_s": 0.4}}
CUT_S = 2.0
"""Longer than any wheels may turn without a word, shorter than DDS takes to miss a participant."""


@contextmanager
def two_computers():
    """The robot's own, and that of its wheels and sensors; what is for a neighbour that is away is not kept."""
    with Namespace() as ours, Namespace() as wheels:
        cable(ours, wheels, ("eth0", "10.9.0.1/24"), ("eth0", "10.9.0.2/24"))
        ours.run(lambda: Path("/proc/sys/net/ipv4/neigh/eth0/unres_qlen_bytes").write_text("1"))
        for where in (ours, wheels):
            where.ip("route", "add", "default", "dev", "eth0")  # for multicast, by which nodes are found
        yield ours, wheels


def test_wheels_that_were_cut_off_hear_a_standstill_first(tmp_path, ros2, monkeypatch):
    """They had stopped by themselves, and the first that they heard again was full speed."""
    monkeypatch.setenv("SKYTETHER_ROS2_PYTHON", ros2)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    with two_computers() as (ours, wheels):

        def cut():
            with PlayedRobot(
                tmp_path, UNHURRIED, hardware=lambda folder: wheels.run(lambda: Ros2Hardware(folder))
            ) as robot:
                robot.go()
                stage = Stage(robot)
                wheels.ip("link", "set", "eth0", "down")
                stage.expect(lambda: "is not acknowledged by /played_hardware" in robot.log.read_text(), "it is named")
                stage.sleep(CUT_S)
                wheels.ip("link", "set", "eth0", "up")
                wheels.ip("route", "add", "default", "dev", "eth0")
                stage.drives_on("the robot drives on when the network is there again")
                return stage.finding(), robot.record.since(0)[1:]

        finding, told = ours.run(cut)
    silences = [after.at - before.at for before, after in pairwise(told)]
    back = told[1 + silences.index(max(silences))]
    assert back.velocity == STANDSTILL, "by the time at which they heard it, too"
    assert [violation.text for violation in finding.violations] == []
    assert finding.velocity_max > 0.4


@pytest.mark.usefixtures("nftables")
def test_no_velocity_is_sent_again_that_was_lost_before_its_writer_stood_still(tmp_path, ros2, monkeypatch):
    """DDS had it still, unacknowledged, and sent it seconds later to wheels that the gate had braked long ago."""
    monkeypatch.setenv("SKYTETHER_ROS2_PYTHON", ros2)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    with two_computers() as (ours, wheels):

        def lose(rule):
            rules = (
                f"add table ip t; add chain ip t i {{ type filter hook input priority 0; }}; flush chain ip t i; {rule}"
            )
            wheels.run(lambda: subprocess.run(["nft", rules], check=True))

        def freeze():
            with PlayedRobot(tmp_path, {}, hardware=lambda folder: wheels.run(lambda: Ros2Hardware(folder))) as robot:
                robot.go()
                lose("add rule ip t i drop")
                time.sleep(0.02)
                os.kill(robot.pid("writer"), signal.SIGSTOP)
                time.sleep(0.005)
                frozen = now()
                lose("")
                time.sleep(4.0)  # longer than the time after which DDS looks who has not acknowledged what
                told = robot.record.since(frozen)[1:]
                os.kill(robot.pid("writer"), signal.SIGCONT)
                return told

        told = [each.velocity.linear for each in ours.run(freeze)]
    stood = told.index(0.0)
    assert max(told[stood:]) == 0.0, "who stands is told no velocity of before"
