"""A robot ahead of a person who steers it with the face and walks after it, over a link with a round trip.

Independent of the controller: what is measured comes later by half the round trip, what is commanded acts later by the
other half, and the wheels follow with a lag. Made-up time; 10 ms a step.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count

from skytether_services.follow_in_front.formation import Command, Formation

TICK = 0.01
LAG = 0.1
"""Time constant of the wheels, s."""
SCAN, FACE, STEP = 10, 7, 10
"""Ticks between scans (10 Hz), pictures (some 15 Hz) and commands (10 Hz), as in table 2 of the thesis."""


@dataclass
class Log:
    """What truly was, step by step of the controller."""

    time: list[float] = field(default_factory=list)
    distance: list[float] = field(default_factory=list)
    heading: list[float] = field(default_factory=list)
    linear: list[float] = field(default_factory=list)
    commands: list[Command] = field(default_factory=list)


def drive(
    formation: Formation,
    seconds: float,
    *,
    round_trip: float = 0.0,
    speed: Callable[[float], float] = lambda _: 0.0,
    gaze: Callable[[float], float] = lambda _: 0.0,
    start: float = 0.9,
    legs: Callable[[float], bool] = lambda _: True,
    face: Callable[[float], bool] = lambda _: True,
    face_every: int = FACE,
) -> Log:
    """Let a person walk behind the robot.

    Args:
        formation: The controller.
        seconds: For so long.
        round_trip: Of the link [s].
        speed: Of the person towards the robot, by time [m/s].
        gaze: Direction to which the person looks, by time [rad, world].
        start: Distance of the person at the beginning [m].
        legs: Whether the laser sees the person.
        face: Whether the camera does.
        face_every: Ticks between pictures.
    """
    x = y = heading = v = w = 0.0
    px, py = -start, 0.0
    log, order = Log(), count()
    up: list[tuple[float, int, Callable[[], None]]] = []
    down: deque[tuple[float, float, float]] = deque()
    target = (0.0, 0.0)
    for tick in range(round(seconds / TICK)):
        now = tick * TICK
        arrives = now + round_trip / 2
        away, u = max(math.hypot(x - px, y - py), 1e-6), speed(now)
        vx, vy = u * (x - px) / away, u * (y - py) / away
        cos, sin = math.cos(heading), math.sin(heading)
        if tick % SCAN == 0 and legs(now):
            seen = (
                cos * (px - x) + sin * (py - y),
                cos * (py - y) - sin * (px - x),
                cos * vx + sin * vy,
                cos * vy - sin * vx,
                now,
            )
            heapq.heappush(up, (arrives, next(order), lambda seen=seen: formation.legs(*seen)))
        if tick % face_every == 0 and face(now):
            angle = math.remainder(gaze(now) - heading, math.tau)
            heapq.heappush(up, (arrives, next(order), lambda angle=angle, at=now: formation.face(angle, at)))
        while up and up[0][0] <= now:
            heapq.heappop(up)[2]()
        if tick % STEP == 0:
            command = formation.step(now)
            down.append((arrives, command.velocity.linear, command.velocity.angular))
            log.time.append(now)
            log.distance.append(away)
            log.heading.append(heading)
            log.linear.append(v)
            log.commands.append(command)
        while down and down[0][0] <= now:
            target = down.popleft()[1:]
        answer = -math.expm1(-TICK / LAG)
        v, w = v + (target[0] - v) * answer, w + (target[1] - w) * answer
        x, y, heading = x + v * cos * TICK, y + v * sin * TICK, heading + w * TICK
        px, py = px + vx * TICK, py + vy * TICK
    return log
