"""Attacks on a robot that is a ROS 1 graph: the same processes and a writer, a master that dies."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from . import deaths, storm
from .attacks import Attacks
from .graphs import ROLES, frozen_in_the_midst, with_a_writer
from .robot import PlayedRobot
from .ros1_hardware import Ros1Hardware
from .stage import Stage


def enter(attacks: Attacks) -> None:
    """Add them."""

    def add(name: str, what: str, run: deaths.Run, seconds: float) -> None:
        attacks.add(f"ros1-{name}", f"ROS 1: {what}", run, seconds=seconds, robot=_robot)

    with_a_writer(add)
    add(*frozen_in_the_midst("writer", "the writer", lambda stage: [stage.robot.pid("writer")]), 6)
    for seed in storm.SEEDS:
        add(f"storm-{seed}", storm.WHAT.format(seed), storm.storm(seed, ROLES), 6)
    add("master-killed", "the master is killed, then the agent; the master starts again", _master, 6)


@contextmanager
def _robot(folder: Path, safety: Mapping[str, Any]) -> Iterator[PlayedRobot]:
    with PlayedRobot(folder, safety, hardware=Ros1Hardware) as robot:
        yield robot


def _graph(stage: Stage) -> Ros1Hardware:
    found = stage.robot.hardware
    if not isinstance(found, Ros1Hardware):
        raise TypeError("this robot is no ROS 1 graph")
    return found


def _master(stage: Stage) -> None:
    graph = _graph(stage)
    graph.end_master()
    try:
        stage.sleep(1.0)
        stage.drives_on("the robot drives on without the master")
        with stage.stands(stage.promised.agent, "the agent was killed, without a master"):
            stage.robot.signal("agent", signal.SIGKILL)
            stage.sleep(1.0)
    finally:
        graph.start_master()
