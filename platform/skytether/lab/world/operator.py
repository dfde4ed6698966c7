"""The operator of the follow-in-front experiment: walks after the robot, and steers it with the face. Pure, by a seed.

A trained person (thesis, section 5.5.2), who knows the marks on the floor and how the robot answers: from where the
robot will be when it answers, they choose a point of the curve ahead of it, know how hard it must turn to get there
(the arc of pure pursuit, Coulter 1992), and look so far aside that it does. What makes them a person: a reaction time,
a neck that turns only so fast and so far, a gaze that wanders, a speed of their own.

The robot's law as they know it: it turns by `gain` for what the face's angle exceeds `dead_band`. It is a person's
experience, not the service's parameters: nobody tells them of the network between.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skytether.lab.trail import Pose

from .gait import Gait
from .lemniscate import Lap, Lemniscate
from .people import Stance
from .robot import Motion

NAME = "operator"
_FIRM = 0.05
"""A turn slower than this is asked for with less than the whole dead band, rad/s: no jumps from side to side."""
_CREEP = 0.05
"""Nobody walks slower than this, m/s: they stand."""


@dataclass(frozen=True, slots=True)
class OperatorParams:
    """The person.

    Attributes:
        speed: Preferred, on the average of people [m/s].
        speed_spread: Standard deviation among people [m/s].
        acceleration: [m/s^2].
        turn_rate: Of the body [rad/s].
        distance: Where they stand at the beginning: from the robot's middle, straight behind [m].
        closing: They walk to the point of the line straight behind the robot that is this much nearer to it than they
            are: so they stay behind it in a curve, where the camera sees the face [m].
        near: Nearer to the robot's middle they stop [m].
        easy: Further away than this they walk as they like; between both slower [m].
        look_ahead: Distance of the point that they steer to from the robot's middle [m].
        gain: Of the robot's law, as who has trained with it knows it [1/s]: it is 0.9, but of a face that points far
            aside the robot's eyes see less.
        dead_band: Likewise [rad].
        speed_time: The robot's speed is seen as smoothed with this time constant: it changes with each step [s].
        answer: From a movement of the head to the robot's turning, as they know it [s].
        reaction: From what they see to a movement of the head [s].
        head_rate: Fastest turn of the head [rad/s].
        widest: The head turns no further from the robot's heading than this [rad].
        wander: Standard deviation of the slow wandering of the gaze [rad].
        wander_time: Its time constant [s].
    """

    speed: float = 0.4
    speed_spread: float = 0.02
    acceleration: float = 0.6
    turn_rate: float = 1.5
    distance: float = 1.0
    closing: float = 0.2
    near: float = 0.65
    easy: float = 0.8
    look_ahead: float = 0.8
    gain: float = 0.75
    dead_band: float = math.radians(5)
    speed_time: float = 0.8
    answer: float = 0.35
    reaction: float = 0.25
    head_rate: float = 1.5
    widest: float = math.radians(45)
    wander: float = math.radians(1.5)
    wander_time: float = 1.5


class Figure(NamedTuple):
    """Where the operator's parts are.

    Attributes:
        stance: Feet and trunk [m].
        body: Heading of the trunk [rad].
        head: Of the face [rad].
    """

    stance: Stance
    body: float
    head: float


class _Seen(NamedTuple):
    """The robot at a time [s]."""

    at: float
    pose: Pose
    motion: Motion


_PARAMS = OperatorParams()


class Operator:
    """Stands behind the robot, walks after it as soon as it drives, and stops after one round.

    Attributes:
        speed: Preferred by this person [m/s].
        pose: Of the body.
        head: Where the face points [rad].
        lap: The robot's round.
    """

    def __init__(
        self, curve: Lemniscate, seed: int, params: OperatorParams = _PARAMS, start: Pose | None = None
    ) -> None:
        """Stand behind a robot that stands at the start; None: where the curve begins."""
        self.params, self.curve = params, curve
        self._random = np.random.default_rng(seed)
        self.speed = params.speed + params.speed_spread * min(max(float(self._random.normal()), -2.0), 2.0)
        self.lap = Lap(curve)
        x, y, heading = start or curve.at(0.0)
        away = params.distance
        self.pose = Pose(x - away * math.cos(heading), y - away * math.sin(heading), heading)
        self.head = heading
        self._gait = Gait(self.pose)
        self._pace = self._robot_speed = 0.0
        self._wander = params.wander * float(self._random.normal())
        self._time = 0.0
        self._seen: deque[_Seen] = deque()

    @property
    def done(self) -> bool:
        """Whether the robot has come round."""
        return self.lap.done

    @property
    def figure(self) -> Figure:
        """Where all of them is."""
        left, right = self._gait.feet
        return Figure(Stance(left, right, self.pose[:2]), self.pose.heading, self.head)

    def face_angle(self, robot: Pose) -> float:
        """Where the face points, off the robot's heading, positive to its left [rad]: what the camera ought to find."""
        return math.remainder(self.head - robot.heading, math.tau)

    def step(self, robot: Pose, motion: Motion, dt: float) -> Figure:
        """Go on for dt seconds behind a robot that is there and moves so."""
        self._time += dt
        self.lap.update(robot.x, robot.y)
        self._robot_speed += (motion.forward - self._robot_speed) * -math.expm1(-dt / self.params.speed_time)
        self._seen.append(_Seen(self._time, robot, Motion(self._robot_speed, 0.0, motion.turning)))
        while len(self._seen) > 1 and self._time - self._seen[1].at >= self.params.reaction:
            self._seen.popleft()
        self._turn_head(robot, dt)
        moved = self._walk(robot, dt)
        self._gait.step(self.pose, moved, dt)
        return self.figure

    def _turn_head(self, robot: Pose, dt: float) -> None:
        p = self.params
        kept = math.exp(-dt / p.wander_time)
        self._wander = kept * self._wander + p.wander * math.sqrt(1 - kept**2) * float(self._random.normal())
        goal = self._wish(self._seen[0]) + self._wander
        # As far as they see now that the neck allows.
        goal = robot.heading + _limited(math.remainder(goal - robot.heading, math.tau), p.widest)
        turn = math.remainder(goal - self.head, math.tau)
        self.head = math.remainder(self.head + _limited(turn, p.head_rate * dt), math.tau)

    def _wish(self, seen: _Seen) -> float:
        """Where to look, by what was seen of the robot a moment ago [rad]."""
        p = self.params
        (x, y, heading), (forward, _, turning) = seen.pose, seen.motion
        if self.done:
            return heading
        ahead = self._time - seen.at + p.answer
        middle = heading + turning * ahead / 2
        x, y = x + forward * ahead * math.cos(middle), y + forward * ahead * math.sin(middle)
        heading += turning * ahead
        goal = self.curve.at(self.lap.s + forward * ahead + p.look_ahead)
        aside = math.remainder(math.atan2(goal.y - y, goal.x - x) - heading, math.tau)
        away = math.hypot(goal.x - x, goal.y - y)
        # Of a robot that stands they ask nothing: they look straight on.
        turn = 2 * max(forward, 0.0) * math.sin(aside) / max(away, p.look_ahead / 2)
        return heading + turn / p.gain + p.dead_band * _limited(turn / _FIRM, 1.0)

    def _walk(self, robot: Pose, dt: float) -> float:
        """Returns the way walked [m]."""
        p, (x, y, heading) = self.params, self.pose
        away = math.dist((x, y), robot[:2])
        share = min(max((away - p.near) / (p.easy - p.near), 0.0), 1.0)
        allowed = self.speed * share if self.speed * share >= _CREEP else 0.0
        wish = 0.0 if self.done else allowed
        # Who is too near stops at once.
        self._pace = min(self._pace + _limited(wish - self._pace, p.acceleration * dt), allowed)
        if self._pace > 0:
            cos, sin = math.cos(robot.heading), math.sin(robot.heading)
            behind = max((robot.x - x) * cos + (robot.y - y) * sin - p.closing, p.closing)
            to_x, to_y = robot.x - behind * cos, robot.y - behind * sin
            turn = math.remainder(math.atan2(to_y - y, to_x - x) - heading, math.tau)
            heading = math.remainder(heading + _limited(turn, p.turn_rate * dt), math.tau)
        way = self._pace * dt
        self.pose = Pose(x + way * math.cos(heading), y + way * math.sin(heading), heading)
        return way


def _limited(value: float, most: float) -> float:
    return min(max(value, -most), most)
