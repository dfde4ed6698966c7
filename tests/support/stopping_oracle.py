"""An independent judge of the stopping way: gate, guard and wheels as they really turn, step by step, in made-up time.

Nothing of the inequality is in here. The world is points; the laser sees them as they were when it measured; the gate's
rules and the guard's watch are the real ones; every latency is drawn anew each time, up to what is allowed.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from random import Random
from typing import Any

import numpy as np

from skytether.guard.protocol import Beat
from skytether.guard.teller import repeat_s
from skytether.guard.velocity import STANDSTILL, Velocity
from skytether.guard.watch import Watch
from skytether.messages import Header, LaserScan, Time
from skytether.robot.control.command import Command, Hand
from skytether.robot.safety.config.safety_config import SafetyConfig
from skytether.robot.safety.gate.heartbeat import differs
from skytether.robot.safety.geometry.footprint import Points
from skytether.robot.safety.rules.rules import Gate

_FINE_S = 0.004
"""Longest piece of the way that is integrated at once."""
_SOON_S = 1e-6
"""Least time to the guard's next turn: rounding must not put it at this very moment, again and again."""
_NEUTRAL_S = 0.5
"""An agent wants a standstill first; the times of a drive count from the end of it."""


@dataclass
class Pose:
    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0

    def move(self, velocity: Velocity, dt: float) -> None:
        """Exactly, along the arc."""
        turn = velocity.angular * dt
        chord = velocity.linear * dt * (math.sin(turn / 2) / (turn / 2) if abs(turn) > 1e-9 else 1.0)
        self.x += chord * math.cos(self.heading + turn / 2)
        self.y += chord * math.sin(self.heading + turn / 2)
        self.heading += turn

    def sees(self, world: Points) -> Points:
        """The world from here."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        return (world - (self.x, self.y)) @ np.array([[c, -s], [s, c]])


@dataclass
class Faults:
    """What goes wrong beside the jitter.

    Attributes:
        jitter: Of each period, a share of it.
        gate_hangs: Chance at each turn that the gate's next turn comes late by up to ``guard_s``.
        gate_dies_at: When the gate says its last word [s].
        late_wheels: Every latency is always the longest allowed; else each is drawn anew.
        scan_s: Between two scans; they are as old as allowed when the next one comes.
    """

    jitter: float = 0.5
    gate_hangs: float = 0.0
    gate_dies_at: float = math.inf
    late_wheels: bool = True
    scan_s: float = 0.1


@dataclass
class Drive:
    """One drive.

    Args:
        config: Of the robot; with one laser named ``scan`` at the origin.
        world: Points that stand still, shape (n, 2) [m].
        wanted: What the agent wants at a time.
        faults: What goes wrong.
        seed: Of all that is drawn.
    """

    config: SafetyConfig
    world: Points
    wanted: Callable[[float], tuple[float, float]]
    faults: Faults = field(default_factory=Faults)
    seed: int = 0
    see_m: float = 50.0
    rays: int = 720
    pose: Pose = field(default_factory=Pose)
    moving: Velocity = STANDSTILL
    fastest: float = 0.0

    def __post_init__(self) -> None:
        self.random = Random(self.seed)
        self.rules = self.config.rules()
        self.gate = Gate(self.rules)
        self.watch = Watch(self.config.bounds(), 1 / self.config.rate_hz, self.config.guard_s)
        self.said = STANDSTILL
        self.now = 100.0
        for sequence, earlier in ((-1, 0.5), (0, 0.1)):  # the agent begins from a standstill
            then = self.now - earlier
            self.gate.command(Command(Hand.AGENT, 0.0, 0.0, 1, sequence, then, 0.0, then), then)
        self._aim = STANDSTILL
        self._events: list[tuple[float, int, str, Any]] = []
        self._count = self._commands = 0
        self._due = self.now
        self._felt = self._heard = 0.0

    def run(self, seconds: float) -> Iterator[None]:
        """Drive; yields after every piece of the way."""
        end = self.now + _NEUTRAL_S + seconds
        for kind in ("measure", "gate", "guard"):
            self._at(self.now, kind)
        while self._events[0][0] < end:
            at, _, kind, what = heapq.heappop(self._events)
            yield from self._roll(at)
            getattr(self, f"_do_{kind}")(what)

    def _at(self, when: float, kind: str, what: Any = None) -> None:
        self._count += 1
        heapq.heappush(self._events, (when, self._count, kind, what))

    def _roll(self, until: float) -> Iterator[None]:
        """The wheels: each axis follows what they feel, as fast as it may brake."""
        limits = self.rules.limits
        while self.now < until:
            dt = min(_FINE_S, until - self.now)
            before = self.moving
            self.moving = Velocity(
                _towards(before.linear, self._aim.linear, limits.linear_braking * dt),
                _towards(before.angular, self._aim.angular, limits.angular_braking * dt),
            )
            middle = Velocity((before.linear + self.moving.linear) / 2, (before.angular + self.moving.angular) / 2)
            self.pose.move(middle, dt)
            self.now += dt
            self.fastest = max(self.fastest, abs(self.moving.linear))
            yield

    def _drawn(self, most: float) -> float:
        return most if self.faults.late_wheels else self.random.uniform(0.0, most)

    def _period(self) -> float:
        return self.rules.stages.period_s * (1 + self.faults.jitter * self.random.uniform(-1, 1))

    def _do_measure(self, _: None) -> None:
        ranges = np.full(self.rays, math.inf)
        near = self.pose.sees(self.world)
        if len(near):
            rays = np.round(np.arctan2(near[:, 1], near[:, 0]) / math.tau * self.rays).astype(int) % self.rays
            np.minimum.at(ranges, rays, np.hypot(near[:, 0], near[:, 1]))
        ranges[ranges > self.see_m] = math.inf
        scan = LaserScan(
            header=Header(stamp=Time(sec=int(self.now), nanosec=int(self.now % 1 * 1e9)), frame_id="laser"),
            angle_increment=math.tau / self.rays,
            range_min=0.01,
            range_max=self.see_m,
            ranges=ranges.astype(np.float32),
        )
        self._at(max(self._heard, self.now + self._drawn(self.rules.stages.sensing_s)), "scan", scan)
        self._at(self.now + self.faults.scan_s, "measure")

    def _do_scan(self, scan: LaserScan) -> None:
        self._heard = self.now
        self.gate.sense("scan", scan, self.now)

    def _do_gate(self, _: None) -> None:
        at = self.now - 100.0 - _NEUTRAL_S
        if at > self.faults.gate_dies_at:
            return
        self._commands += 1
        linear, angular = self.wanted(at) if at > 0 else (0.0, 0.0)
        self.gate.command(Command(Hand.AGENT, linear, angular, 1, self._commands, self.now, 0.0, self.now), self.now)
        told = differs(self.watch.told, self.said, self.now, self.config.guard_s, 1 / self.config.rate_hz)
        if told is not None:
            self.gate.rebase(*told)
        decision = self.gate.step(self.now)
        self.said = decision.velocity
        self._at(self.now + 1e-4, "beat", Beat(self.now, decision.velocity))
        gap = self._period()
        if self.random.random() < self.faults.gate_hangs:
            gap = max(gap, self.random.uniform(0.0, self.config.guard_s))
        self._at(self.now + gap, "gate")

    def _do_beat(self, beat: Beat) -> None:
        self.watch.on_beat(beat)
        self._look()

    def _do_guard(self, _: None) -> None:
        """The guard waits for the gate until it has to speak by itself, and is late by up to a period then."""
        if self.now >= self._due:
            self._look()
        late = self.rules.stages.period_s * self.faults.jitter * self.random.uniform(0, 1)
        self._at(max(self._due + late, self.now + _SOON_S), "guard")

    def _look(self) -> None:
        velocity, _ = self.watch.want(self.now)
        self.watch.wrote(velocity, self.now)
        stages = self.rules.stages
        self._due = self.watch.due(self.now, repeat_s(stages.period_s, stages.guard_s))
        self._felt = max(self._felt, self.now + self._drawn(stages.writer_s) + self._drawn(stages.wheels_s))
        self._at(self._felt, "feel", velocity)

    def _do_feel(self, velocity: Velocity) -> None:
        self._aim = velocity


def _towards(value: float, target: float, most: float) -> float:
    return target if abs(target - value) <= most else value + math.copysign(most, target - value)


def deepest(drive: Drive, seconds: float) -> float:
    """How far into the stop zone anything got in this drive, at worst [m]; negative: it stayed that far outside."""
    zone = drive.rules.footprint.inflated(drive.rules.zones.stop_m)
    worst = -math.inf
    for _ in drive.run(seconds):
        worst = max(worst, -float(zone.outside(drive.pose.sees(drive.world)).min()))
    return worst
