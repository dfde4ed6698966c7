"""Where an attack is staged: a robot that drives, and what is demanded of its wheels meanwhile."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from skytether.guard.clock import now
from skytether.robot.control.supervisor import VelocityLimits
from skytether.robot.safety.client import GateError
from skytether.robot.safety.config.safety_config import SafetyConfig

from .checker import Demand, Finding, Violation, Wheels, check
from .robot import PlayedRobot, StagingError

_TURNS = 2
"""Of the gate's loop: until it has seen what happened, and until the guard has told the wheels."""


@dataclass(frozen=True, slots=True)
class Promised:
    """How long it may take until the robot stands, as the configuration has it [s].

    Attributes:
        agent: After the agent's last command.
        partner: After the last word of gate or guard.
        sensor: After a laser's last reading.
        button: After the last word of the button.
        joystick: After the joystick's last word.
        still: After the joystick's last change.
        stop: After a stop, by a person or a button.
        silence: After the last word of gate and guard: the wheels stop by themselves; on a graph the writer brakes.
        jitter: What each of these has in addition, for how well times are known.
    """

    agent: float
    partner: float
    sensor: float
    button: float
    joystick: float
    still: float
    stop: float
    silence: float
    jitter: float

    @classmethod
    def of(cls, config: SafetyConfig) -> Promised:
        """Those of a configuration: what it waits for, two turns, and braking from full speed."""
        limits = config.limits or VelocityLimits()
        period = 1 / config.rate_hz
        brakes = max(limits.linear_max / limits.linear_braking, limits.angular_max / limits.angular_braking)
        turns = _TURNS if config.graph is None else _TURNS + 1  # the writer's
        rest = turns * period + brakes + period
        return cls(
            agent=limits.max_gap_s + rest,
            partner=config.guard_s + rest,
            sensor=max((sensor.max_age_s for sensor in config.sensors.values()), default=0.0) + rest,
            button=((config.estop and config.estop.max_age_s) or 0.0) + rest,
            joystick=(config.joystick.max_age_s if config.joystick else 0.0) + rest,
            still=((config.joystick and config.joystick.max_still_s) or 0.0) + rest,
            stop=rest,
            silence=config.guard_s + (_TURNS * period if config.graph is None else rest),
            jitter=period,
        )


def wheels_of(config: SafetyConfig) -> Wheels:
    """What holds always for the wheels of a configuration.

    On a graph two periods of tolerance: the time is that of the receipt, and the writer has turns of its own.
    """
    periods = 1 if config.graph is None else 2
    return Wheels(config.limits or VelocityLimits(), silence_s=config.guard_s, jitter_s=periods / config.rate_hz)


class Stage:
    """One repetition of an attack.

    Args:
        robot: To be attacked.
    """

    def __init__(self, robot: PlayedRobot) -> None:
        self.robot = robot
        self.promised = Promised.of(robot.config)
        self._began = now()
        self._demands: list[Demand] = []
        self._seen: list[Violation] = []

    @contextmanager
    def stands(self, within_s: float, why: str) -> Iterator[None]:
        """The robot has to come to a standstill, counted from the beginning of the block, and stay so until its end."""
        with self.slows(0.0, within_s, why):
            yield

    @contextmanager
    def slows(self, speed: float, within_s: float, why: str) -> Iterator[None]:
        """The robot has to be as slow as that [m/s], in time, until the end of the block."""
        since = now()
        yield
        self._demands.append(Demand(since, within_s, now(), why, speed))

    def stood(self, since: float, within_s: float, why: str) -> None:
        """The robot had to come to a standstill after a moment [s], and to stay so until now."""
        self._demands.append(Demand(since, within_s, now(), why))

    def stop(self, reason: str = "an attack") -> bool:
        """Emergency stop; whether it was acknowledged."""
        try:
            self.robot.stop(reason)
        except (GateError, UnicodeError) as error:
            self.wrong("stop", f"the stop is not acknowledged: {error}")
            return False
        return True

    def wrong(self, kind: str, text: str) -> None:
        """Something else that was promised is not so."""
        self._seen.append(Violation(now(), kind, text))

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        time.sleep(seconds)

    def drives_on(self, why: str) -> None:
        """The robot has to drive again by itself, at some time."""
        self.expect(self.robot.drives, why)

    def expect(self, condition: Callable[[], bool], why: str) -> None:
        """Something has to come about, at some time."""
        try:
            self.robot.wait(condition, why)
        except StagingError as error:
            self.wrong("stuck", str(error).partition("\n")[0])

    def timed(self, act: Callable[[], object], why: str, within_s: float) -> None:
        """Something must not take longer than that [s]."""
        since = now()
        act()
        took = now() - since
        if took > within_s:
            self.wrong("late", f"{why} after {took:.3f} s; {within_s:.3f} s is the most")

    def finding(self) -> Finding:
        """What the wheels received since the beginning, held against all that was demanded."""
        found = check(self.robot.record.since(self._began), self._demands, wheels_of(self.robot.config))
        return Finding(
            violations=(*found.violations, *self._seen),
            velocity_max=found.velocity_max,
            acceleration_max=found.acceleration_max,
            standstill=found.standstill,
        )
