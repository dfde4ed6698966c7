"""Attacks on a robot that is a ROS 1 graph: the same processes and a writer, a master that dies."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import permutations
from pathlib import Path
from typing import Any

from . import deaths, hardware, stops, storm
from .attacks import Attacks
from .robot import PlayedRobot
from .ros1_hardware import Ros1Hardware
from .stage import Stage

_ROLES = ("agent", "gate", "guard", "writer")
_FROZEN_S = 1.0


def enter(attacks: Attacks) -> None:
    """Add them."""

    def add(name: str, what: str, run: deaths.Run, seconds: float) -> None:
        attacks.add(f"ros1-{name}", f"ROS 1: {what}", run, seconds=seconds, robot=_robot)

    for role in _ROLES:
        add(f"{role}-killed", f"the {role} is killed", deaths.killed(role), 4)
        add(f"{role}-frozen", f"the {role} is frozen for 1 s, and goes on", deaths.frozen(role, _FROZEN_S), 3)
    for first, second in permutations(("gate", "guard", "writer"), 2):
        add(
            f"{first}-{second}-killed",
            f"the {first} is killed, then the {second}",
            deaths.both_killed(first, second),
            5,
        )
    add("guard-terminated", "the guard is told to end", deaths.ended(signal.SIGTERM, everybody=False), 5)
    add("stop-gate-killed", "a stop is acknowledged, and the gate killed", stops.stop_and_kill("gate"), 5)
    add("wheels-gone", "the wheels' node is gone for 0.5 s", hardware.wheels_gone(0.5), 3)
    add("laser-silent", "the laser falls silent", hardware.blind("nothing any more", lambda _: lambda: None), 4)
    for seed in storm.SEEDS:
        add(f"storm-{seed}", storm.WHAT.format(seed), storm.storm(seed, _ROLES), 6)
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
