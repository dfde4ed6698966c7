"""The machine is suspended and goes on: the parts of gate and guard that decide, with a made-up clock. No processes.

Nothing runs meanwhile. Then the clock is ahead by the time that the machine slept, and the first turns find what
waited in the sockets: the agent's last command, and the last scan. Neither may move the robot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from skytether.guard.protocol import Beat
from skytether.guard.velocity import STANDSTILL
from skytether.guard.watch import Watch
from skytether.messages import Bool, LaserScan
from skytether.robot.control.command import Command, Hand
from skytether.robot.safety.config.safety_config import SafetyConfig
from skytether.robot.safety.gate.heartbeat import differs
from skytether.robot.safety.rules.rules import Gate

from .attacks import Attacks
from .checker import Demand, Finding, SentVelocity, Violation, check
from .robot import RAYS, SAFETY, WANTED, scan_of
from .stage import Promised, wheels_of

_SLEEPS_S = (0.3, 2.0, 36_000.0)
_AWAKE_S = 3.0
_OLD_S = 0.5
"""For so long after the sleep nothing new comes: the agent and the laser's driver take their time."""


def enter(attacks: Attacks) -> None:
    """Add them."""
    for seconds in _SLEEPS_S:
        attacks.add_rehearsal(
            f"suspend-{seconds:g}",
            f"rehearsed with a made-up clock: the machine sleeps for {seconds:g} s",
            _suspend(seconds),
        )


def _suspend(seconds: float) -> Callable[[], Finding]:
    def run() -> Finding:
        config = SafetyConfig.model_validate(SAFETY)
        robot = _Rehearsed(config)
        robot.turns(_AWAKE_S, new=True)
        robot.leave_waiting()
        driven = robot.told[-1].velocity.linear
        slept_at = robot.now
        robot.now += seconds
        robot.turns(_OLD_S, new=False)
        old = Demand(slept_at, Promised.of(config).silence, robot.now, f"the machine slept for {seconds:g} s")
        robot.turns(_AWAKE_S, new=True)
        finding = check(robot.told, [old], wheels_of(config))
        found = list(finding.violations)
        for speed, when in ((driven, "before the sleep"), (robot.told[-1].velocity.linear, "after it")):
            if speed < 0.9 * WANTED.linear:
                found.append(Violation(robot.now, "stuck", f"the robot drives {speed:.3f} m/s {when}"))
        return Finding(tuple(found), finding.velocity_max, finding.acceleration_max, finding.standstill)

    return run


class _Rehearsed:
    """Gate and guard in one loop, as their processes have them in two."""

    def __init__(self, config: SafetyConfig) -> None:
        self.now = 1000.0
        self.told: list[SentVelocity] = [SentVelocity(self.now, STANDSTILL)]
        self._period, self._patience = 1 / config.rate_hz, config.guard_s
        self._gate = Gate(config.rules())
        self._watch = Watch(config.bounds(), self._period, config.guard_s)
        self._said = STANDSTILL
        self._count = 0
        self._started = False
        self._waits: tuple[Command, LaserScan] | None = None

    def turns(self, seconds: float, new: bool) -> None:
        """The loop, for a while; without anything new, only what waited before is found in the first turn."""
        for _ in range(round(seconds / self._period)):
            self.now += self._period
            if new:
                self._waits = self._new()
            if self._waits is not None:
                command, scan = self._waits
                self._gate.sense("estop", Bool(), self.now)
                self._gate.sense("scan", scan, self.now)
                self._gate.command(replace(command, received_at=self.now), self.now)
                self._waits = None
            if not self._started:
                self._started = bool(self._gate.start(self.now)[0])
            self._turn()

    def leave_waiting(self) -> None:
        """A command and a scan come, and nobody looks."""
        self._waits = self._new()

    def _new(self) -> tuple[Command, LaserScan]:
        self._count += 1
        command = Command(Hand.AGENT, *WANTED, 1, self._count, self.now, 0.0, self.now)
        return command, scan_of(np.full(RAYS, 5.0, dtype=np.float32), wall_s=self.now)

    def _turn(self) -> None:
        if (told := differs(self._watch.told, self._said, self.now, self._patience, self._period)) is not None:
            self._gate.rebase(*told)
        self._said = self._gate.step(self.now).velocity
        self._watch.on_beat(Beat(self.now, self._said))
        velocity, _ = self._watch.want(self.now)
        self._watch.wrote(velocity, self.now)
        self.told.append(SentVelocity(self.now, velocity))
