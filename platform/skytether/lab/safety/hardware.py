"""Attacks by the hardware: a wheels' driver that starts again, lasers that do not see, a joystick that was lost."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import cycle

import numpy as np

from skytether.messages import Joy, LaserScan

from .attacks import Attacks
from .robot import RAYS, scan_of
from .stage import Stage

_BLIND_S = 1.5
_HELD = np.array([1], dtype=np.int32)
_RELEASED = np.zeros(1, dtype=np.int32)
_SECOND_SCAN_S = 0.3

Scan = Callable[[], LaserScan | None]


def enter(attacks: Attacks) -> None:
    """Add them."""
    for seconds in (0.05, 0.5, 2.0):
        attacks.add(
            f"wheels-gone-{seconds:g}",
            f"the wheels' driver is gone for {seconds:g} s",
            _wheels_gone(seconds),
            seconds=seconds + 1.5,
        )
    for name, what, scan in (
        ("minus-infinity", "all rays minus infinity", _all(-math.inf)),
        ("minus-one", "all rays -1", _all(-1.0)),
        ("below-range-min", "all rays below range_min", _all(0.01)),
        ("nan", "all rays NaN", _all(math.nan)),
        ("one-ray", "one ray, backward", _few(1)),
        ("four-rays", "four rays, 90 degrees apart", _few(4)),
        ("silent", "nothing any more", lambda: None),
        ("two-old", "two old scans in turn", None),
        ("old-stamps", "scans that are 10 s old", _old),
    ):
        attacks.add(f"laser-{name}", f"the laser sends {what}", _blind(what, scan), seconds=3.5)
    attacks.add("joystick-lost", "the joystick falls silent with its button held, and comes back so", _lost, seconds=4)


def _wheels_gone(seconds: float) -> Callable[[Stage], None]:
    def run(stage: Stage) -> None:
        stage.robot.record.vanish()
        stage.sleep(seconds)
        stage.robot.record.appear()
        stage.drives_on(f"the robot drives on after the wheels' driver was gone for {seconds:g} s")

    return run


def _blind(what: str, scan: Scan | None) -> Callable[[Stage], None]:
    """Whoever does not see stands, or is as slow as the slow zone has it."""

    def run(stage: Stage) -> None:
        shown = scan
        if shown is None:
            shown = _two_old(stage)
        speed = stage.robot.config.zones.slow_speed
        with stage.slows(speed, stage.promised.sensor, f"the laser sends {what}"):
            stage.robot.scan = shown
            stage.sleep(_BLIND_S)
        stage.robot.scan = stage.robot.clear

    return run


def _all(value: float) -> Scan:
    return lambda: scan_of(np.full(RAYS, value, dtype=np.float32))


def _few(rays: int) -> Scan:
    """The first one looks backward; nothing is near any of them."""
    return lambda: scan_of(np.full(rays, 5.0, dtype=np.float32), step=2 * math.pi / rays)


def _old() -> LaserScan:
    return scan_of(np.full(RAYS, 5.0, dtype=np.float32), age_s=10.0)


def _two_old(stage: Stage) -> Scan:
    first = stage.robot.clear()
    stage.sleep(_SECOND_SCAN_S)
    return cycle((first, stage.robot.clear())).__next__


def _lost(stage: Stage) -> None:
    robot = stage.robot
    axes = np.array([0.8, 0.0], dtype=np.float32)
    robot.pad = lambda: Joy(axes=axes, buttons=_HELD)
    robot.wait(lambda: robot.velocity.linear > 0 and robot.velocity.angular == 0, "the joystick drives the robot")
    with stage.stands(stage.promised.joystick, "the joystick was lost with its button held"):
        robot.pad = None
        stage.sleep(1.0)
        robot.pad = lambda: Joy(axes=axes, buttons=_HELD)  # it is heard again, the button never released
        stage.sleep(1.0)
    robot.pad = lambda: Joy(axes=np.zeros(2, dtype=np.float32), buttons=_RELEASED)
    stage.sleep(0.3)
    robot.pad = None
