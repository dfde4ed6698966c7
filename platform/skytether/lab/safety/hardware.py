"""Attacks by the hardware: a wheels' driver that starts again, lasers that do not see, a joystick that was lost."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from itertools import cycle

import numpy as np

from skytether.guard.clock import now
from skytether.messages import Header, Joy, LaserScan, Time

from .attacks import Attacks
from .robot import RAYS, scan_of
from .socket_hardware import SocketHardware
from .stage import Stage

_BLIND_S = 1.5
_UP_S = 0.4
"""The button is up for so long before it is pressed."""
_SECOND_SCAN_S = 0.3

Scan = Callable[[], LaserScan | None]


def enter(attacks: Attacks) -> None:
    """Add them."""
    for seconds in (0.05, 0.5, 2.0):
        attacks.add(
            f"wheels-gone-{seconds:g}",
            f"the wheels' driver is gone for {seconds:g} s",
            wheels_gone(seconds),
            seconds=seconds + 1.5,
        )
    for seconds in (0.15, 0.25, 0.35, 1.0):
        attacks.add(
            f"wheels-hang-{seconds:g}",
            f"the wheels' driver does not read for {seconds:g} s, and then reads all",
            _wheels_hang(seconds),
            seconds=seconds + 1.5,
        )
    for name, what, scan in (
        ("minus-infinity", "all rays minus infinity", _all(-math.inf)),
        ("minus-one", "all rays -1", _all(-1.0)),
        ("below-range-min", "all rays below range_min", _all(0.01)),
        ("nan", "all rays NaN", _all(math.nan)),
        ("one-ray", "one ray, backward", _few(1)),
        ("four-rays", "four rays, 90 degrees apart", _few(4)),
        ("silent", "nothing any more", lambda _: lambda: None),
        ("two-old", "two old scans in turn", _two_old),
        ("late", "scans that come later and later", _late),
    ):
        attacks.add(f"laser-{name}", f"the laser sends {what}", blind(what, scan), seconds=3.5)
    attacks.add("joystick-lost", "the joystick falls silent with its button held, and comes back so", _lost, seconds=4)
    attacks.add("joystick-repeated", "the joystick's driver repeats the last state for ever", _still, seconds=5)


def wheels_gone(seconds: float) -> Callable[[Stage], None]:
    """Nobody listens to the velocities for a while [s]."""

    def run(stage: Stage) -> None:
        stage.robot.hardware.vanish()
        stage.sleep(seconds)
        stage.robot.hardware.appear()
        stage.drives_on(f"the robot drives on after the wheels' driver was gone for {seconds:g} s")

    return run


def _wheels_hang(seconds: float) -> Callable[[Stage], None]:
    def run(stage: Stage) -> None:
        wheels = stage.robot.hardware
        if not isinstance(wheels, SocketHardware):
            raise TypeError("the wheels of this robot are on a graph")
        wheels.hang(seconds)
        stage.sleep(seconds)
        stage.drives_on(f"the robot drives on after the wheels' driver did not read for {seconds:g} s")

    return run


def blind(what: str, shown: Callable[[Stage], Scan]) -> Callable[[Stage], None]:
    """Whoever does not see stands, or is as slow as the slow zone has it."""

    def run(stage: Stage) -> None:
        scan = shown(stage)
        speed = stage.robot.config.zones.slow_speed
        with stage.slows(speed, stage.promised.sensor, f"the laser sends {what}"):
            stage.robot.scan = scan
            stage.sleep(_BLIND_S)
        stage.robot.scan = stage.robot.clear

    return run


def _all(value: float) -> Callable[[Stage], Scan]:
    return lambda _: lambda: scan_of(np.full(RAYS, value, dtype=np.float32))


def _few(rays: int) -> Callable[[Stage], Scan]:
    """The first one looks backward; nothing is near any of them."""
    return lambda _: lambda: scan_of(np.full(rays, 5.0, dtype=np.float32), step=2 * math.pi / rays)


def _late(_: Stage) -> Scan:
    """What a driver sends that does not keep up: each second of scans takes ten."""
    began = now()
    return lambda: scan_of(np.full(RAYS, 5.0, dtype=np.float32), age_s=0.9 * (now() - began))


def _two_old(stage: Stage) -> Scan:
    first = stage.robot.clear()
    stage.sleep(_SECOND_SCAN_S)
    return cycle((first, stage.robot.clear())).__next__


class _Pad:
    """A joystick in a hand that is never quite still, until the radio is lost."""

    def __init__(self) -> None:
        self.held = False
        self.lost = False
        """Its driver goes on with the last that it had."""
        self._shakes = cycle((0.80, 0.81))
        self._axis = 0.0

    def __call__(self) -> Joy:
        if not self.lost:
            self._axis = next(self._shakes) if self.held else 0.0
        wall = time.time_ns()
        return Joy(
            header=Header(stamp=Time(wall // 10**9, wall % 10**9)),
            axes=np.array([self._axis, 0.0], dtype=np.float32),
            buttons=np.array([int(self.held)], dtype=np.int32),
        )


def _take_over(stage: Stage) -> _Pad:
    """A person takes the joystick, holds its button and drives."""
    robot = stage.robot
    pad = robot.pad = _Pad()
    stage.sleep(_UP_S)
    pad.held = True
    robot.wait(lambda: robot.velocity.linear > 0 and robot.velocity.angular == 0, "the joystick drives the robot")
    stage.sleep(_UP_S)
    return pad


def _leave(stage: Stage, pad: _Pad) -> None:
    """The button is released, and the joystick put away."""
    pad.lost = pad.held = False
    stage.robot.pad = pad
    stage.sleep(_UP_S)
    stage.robot.pad = None


def _lost(stage: Stage) -> None:
    pad = _take_over(stage)
    with stage.stands(stage.promised.joystick, "the joystick was lost with its button held"):
        stage.robot.pad = None
        stage.sleep(1.0)
        stage.robot.pad = pad  # it is heard again, the button never released
        stage.sleep(1.0)
    _leave(stage, pad)


def _still(stage: Stage) -> None:
    pad = _take_over(stage)
    with stage.stands(stage.promised.still, "the joystick's driver repeats its last state without end"):
        pad.lost = True
        stage.sleep(stage.promised.still + 0.5)
    _leave(stage, pad)
