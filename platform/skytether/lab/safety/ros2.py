"""Attacks on a robot that is a ROS 2 graph: the same processes, a writer, and the programs that are their nodes."""

from __future__ import annotations

import contextlib
import math
import os
import signal
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from skytether.guard.velocity import STANDSTILL

from . import deaths, storm
from .attacks import Attacks
from .graphs import ROLES, frozen_in_the_midst, with_a_writer
from .robot import PlayedRobot, scan_of
from .ros2_hardware import Ros2Hardware
from .stage import Stage

_FREEZES_S = (0.2, 1.0, 3.0)
_MANY_RAYS = 10_000
_PILES_UP_S = 1.5
"""Of such scans in the buffer between the gate and its program: it is full."""
_NAMED = "the subscription of /stranger has type std_msgs/msg/String"
_UNREAD = "is not acknowledged by /played_hardware"
_PROGRAM = "ros2/native/side/__main__.py"


def enter(attacks: Attacks) -> None:
    """Add them."""

    def add(name: str, what: str, run: deaths.Run, seconds: float) -> None:
        attacks.add(f"ros2-{name}", f"ROS 2: {what}", run, seconds=seconds, robot=_robot)

    with_a_writer(add)
    for role in ("writer", "gate"):
        words = f"the {role}'s program" if role == "writer" else "each program of the gate"
        add(f"{role}-program-killed", f"{words} is killed", _killed(role), 8)
        for seconds in _FREEZES_S:
            what = f"{words} is frozen for {seconds:g} s, and goes on"
            add(f"{role}-program-frozen-{seconds:g}", what, _frozen(role, seconds), seconds + 2)
    for dies in ("", "gate", "writer"):
        frozen = frozen_in_the_midst("writer-program", "the writer's program", partial(_programs, role="writer"), dies)
        add(*frozen, 8)
    add("program-frozen-stop", "a stop while the writer's program is frozen", _frozen_and("stop"), 4)
    add("program-frozen-agent", "the agent is killed while the writer's program is frozen", _frozen_and("agent"), 4)
    add("program-frozen-writer", "the writer is killed while its program is frozen", _frozen_and("writer"), 6)
    farewell = "the writer is killed, its program frozen before its farewell, and goes on when another one drives"
    add("program-frozen-farewell", farewell, _farewell, 10)
    add(
        "button-gate-frozen",
        "the button is pressed for a moment while the gate is frozen and scans pile up",
        _button,
        5,
    )
    add("wheels-frozen", "the wheels' node is frozen for 1 s, and goes on", _wheels_frozen, 5)
    add("stranger", "another node listens to the velocities, as if they were of another type", _stranger, 5)
    for seed in storm.SEEDS:
        add(f"storm-{seed}", storm.WHAT.format(seed), storm.storm(seed, ROLES), 6)


def _programs(stage: Stage, role: str) -> list[int]:
    """Of the nodes that a process has."""
    children = psutil.Process(stage.robot.pid(role)).children()
    return [child.pid for child in children if any(word.endswith(_PROGRAM) for word in child.cmdline())]


def _killed(role: str) -> deaths.Run:
    def run(stage: Stage) -> None:
        victims = _programs(stage, role)
        promised = stage.promised
        within = promised.partner if role == "writer" else promised.button
        with stage.stands(within, f"what has the nodes of the {role} was killed"):
            for victim in victims:
                stage.robot.kill(victim)
            stage.expect(lambda: stage.robot.velocity == STANDSTILL, "the robot stands")
        stage.expect(lambda: len(_programs(stage, role)) == len(victims), "the nodes are there again")

    return run


def _frozen(role: str, seconds: float) -> deaths.Run:
    def run(stage: Stage) -> None:
        for victim in _programs(stage, role):
            stage.robot.kill(victim, signal.SIGSTOP)
        stage.sleep(seconds)
        for victim in _programs(stage, role):
            stage.robot.kill(victim, signal.SIGCONT)
        stage.sleep(1.0)
        stage.robot.start()
        stage.drives_on(f"the robot drives on after what has the nodes of the {role} was frozen for {seconds:g} s")

    return run


def _frozen_and(what: str) -> deaths.Run:
    """Whatever waits in a frozen program is not what the wheels are told when it goes on."""

    def run(stage: Stage) -> None:
        (frozen,) = _programs(stage, "writer")
        with stage.stands(stage.promised.agent, f"the writer's program was frozen; {what}"):
            stage.robot.kill(frozen, signal.SIGSTOP)
            stage.sleep(0.5)
            if what == "stop":
                stage.stop()
            else:
                stage.robot.signal(what, signal.SIGKILL)
            stage.sleep(0.5)
        # The next writer, when its program is there, drives on: from the standstill.
        with contextlib.nullcontext() if what == "writer" else stage.stands(0.0, "the program goes on"):
            stage.sleep(0.5)
            stage.robot.kill(frozen, signal.SIGCONT)
            stage.sleep(0.4)

    return run


def _farewell(stage: Stage) -> None:
    """A program whose writer has died tells the wheels to stand, if nobody else tells them anything."""
    (program,) = _programs(stage, "writer")
    stage.robot.signal("writer", signal.SIGKILL)
    stage.sleep(0.05)
    stage.robot.kill(program, signal.SIGSTOP)
    stage.sleep(3.0)
    stage.robot.start()
    stage.drives_on("the robot drives on by the next writer")
    stage.robot.kill(program, signal.SIGCONT)
    stage.sleep(1.5)


def _button(stage: Stage) -> None:
    robot = stage.robot
    robot.scan = lambda: scan_of(np.full(_MANY_RAYS, 5.0, dtype=np.float32), step=2 * math.pi / _MANY_RAYS)
    gate = robot.signal("gate", signal.SIGSTOP)
    stage.sleep(_PILES_UP_S)
    with stage.stands(0.0, "the button was pressed for a moment while the gate was frozen and the robot stood"):
        robot.pressed = True
        stage.sleep(0.1)
        robot.pressed = False
        stage.sleep(0.5)
        robot.kill(gate, signal.SIGCONT)
        stage.sleep(1.0)
    if not robot.ask("status")["stopped"]:
        stage.wrong("stop", "the press is lost: the status says that the robot is not stopped")
    robot.scan = robot.clear


def _wheels_frozen(stage: Stage) -> None:
    """Wheels that hear nothing stop by themselves: the first that they hear again is to find them so."""
    graph = _graph(stage)
    graph.freeze()
    try:
        stage.expect(lambda: _UNREAD in stage.robot.log.read_text(), "it is named who does not acknowledge velocities")
        stage.sleep(1.0)
        told = stage.robot.ask("status")["linear_m_s"]
        if told:
            stage.wrong("motion", f"wheels that have heard nothing for a second are told {told:.3f} m/s")
    finally:
        graph.thaw()
    stage.drives_on("the robot drives on after the wheels' node was frozen")


def _stranger(stage: Stage) -> None:
    graph = _graph(stage)
    graph.intrude()
    try:
        stage.expect(lambda: _NAMED in stage.robot.log.read_text(), "the gate names who asks for another type")
        stage.sleep(0.5)
        if not stage.robot.drives():
            stage.wrong("stuck", "a node that listens takes the wheels away")
    finally:
        graph.leave()


def _graph(stage: Stage) -> Ros2Hardware:
    graph = stage.robot.hardware
    if not isinstance(graph, Ros2Hardware):
        raise TypeError("this robot is no ROS 2 graph")
    return graph


@contextmanager
def _robot(folder: Path, safety: Mapping[str, Any]) -> Iterator[PlayedRobot]:
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")  # what is played is for this machine
    with PlayedRobot(folder, safety, hardware=Ros2Hardware) as robot:
        yield robot
