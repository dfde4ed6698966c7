"""A person who walks with the walker: pushes, corrects, wobbles; with reaction time and imperfect sight.

Body and walker are tied by the arms, one spring and damper along the way and one about the vertical axis. The person
wants a motion; what the walker does instead stretches the arms, which is the force that the sensors feel, and after
a reaction time the person gives way to the stretch. So the person pushes harder when the walker is slow to answer, is
pulled along when it does not stop, and is part of the control loop (thesis section 2.4, "cognitive loop").

The way is seen as a point ahead, imperfectly: seeing errs by a slowly wandering angle. That is enough to finish a trail
with an unguided walker, less exactly than with guidance.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from skytether.control.admittance import STANDSTILL, Velocity

from .trail import Pose, Progress, Trail
from .walker import Arms

T = TypeVar("T")
V = TypeVar("V", float, "np.typing.NDArray[np.float64]")


@dataclass(frozen=True, slots=True)
class PersonParams:
    """Who walks.

    Attributes:
        speed: Speed at which the person would walk if nothing resisted [m/s].
        speed_error: Standard deviation of that wish, which wanders [m/s].
        speed_wander: Time over which it wanders [s].
        reaction_time: From feeling or seeing to acting [s].
        stiffness: Of both arms together against the walker, forward [N/m].
        damping: The same [N s/m].
        yielding: Rate at which the person gives way to a stretch of the arms [1/s].
        strongest: Largest push or pull, both arms together [N].
        turn_stiffness: Of the arms about the vertical axis [N m/rad].
        turn_damping: The same [N m s/rad].
        turn_yielding: Rate at which the person gives way to a twist of the arms [1/s].
        strongest_turn: Largest torque [N m].
        look_ahead: Distance of the point of the way that the person walks to [m].
        steering: Turning rate wanted per angle to that point [1/s].
        sight_error: Standard deviation of the angle seen [rad].
        sight_wander: Time over which that error wanders [s].
        step_rate: Steps per second [Hz]; also the frequency of the push's oscillation.
        step_force: Amplitude of that oscillation, both arms together [N]; in full at walking speed.
        sway_torque: Amplitude of the sway from leg to leg, at half the step rate [N m].
        tremor: Standard deviation of each arm's unsteadiness [N].
    """

    speed: float = 0.45
    speed_error: float = 0.06
    speed_wander: float = 2.5
    reaction_time: float = 0.2
    stiffness: float = 300.0
    damping: float = 40.0
    yielding: float = 2.5
    strongest: float = 80.0
    turn_stiffness: float = 15.0
    turn_damping: float = 3.0
    turn_yielding: float = 2.5
    strongest_turn: float = 8.0
    look_ahead: float = 0.8
    steering: float = 0.9
    sight_error: float = 0.12
    sight_wander: float = 1.5
    step_rate: float = 1.7
    step_force: float = 5.0
    sway_torque: float = 0.5
    tremor: float = 0.8


_TREMOR_TIME = 0.08
"""Correlation time of the arms' unsteadiness, s: about 2 Hz of bandwidth."""

_PHASE_NOISE = 0.6
"""Wander of the step's phase, rad per square root of second: no two steps are alike."""


class Person:
    """Feels the walker's motion, sees the trail, gives forces."""

    def __init__(self, params: PersonParams, trail: Trail, random: np.random.Generator) -> None:
        """Stands at the start, arms relaxed."""
        self.params = params
        self._trail = trail
        self._random = random
        self._progress = Progress(trail)
        self._forward = _Arm(params.stiffness, params.damping, params.yielding, params.strongest, params.reaction_time)
        self._around = _Arm(
            params.turn_stiffness,
            params.turn_damping,
            params.turn_yielding,
            params.strongest_turn,
            params.reaction_time,
        )
        self._seen = _Delay(params.reaction_time, STANDSTILL)
        self._sight = 0.0
        self._mood = 0.0
        self._tremor = np.zeros(2)
        self._phase = 0.0

    def step(self, pose: Pose, velocity: Velocity, sensor_distance: float, dt: float, *, walking: bool = True) -> Arms:
        """Forces over the next dt seconds on a walker that is and moves like this.

        Args:
            pose: The walker's true pose.
            velocity: The walker's true velocity.
            sensor_distance: Distance between the forearm supports [m].
            dt: Step [s].
            walking: False: the person stands and waits.
        """
        p = self.params
        wish = self._seen.step(self._wish(pose, dt) if walking else STANDSTILL, dt)
        push = self._forward.step(wish.linear, velocity.linear, dt)
        torque = self._around.step(wish.angular, velocity.angular, dt)
        stride = min(abs(velocity.linear) / 0.2, 1.0)
        self._phase += math.tau * p.step_rate * dt + _PHASE_NOISE * math.sqrt(dt) * self._random.normal()
        push += stride * p.step_force * math.sin(self._phase)
        torque += stride * p.sway_torque * math.sin(self._phase / 2)
        self._tremor += _wander(self._tremor, p.tremor, _TREMOR_TIME, dt, self._random.normal(size=2))
        # torque = (right - left) d / 2, push = left + right
        half = torque / sensor_distance
        return Arms(push / 2 - half + float(self._tremor[0]), push / 2 + half + float(self._tremor[1]))

    def _wish(self, pose: Pose, dt: float) -> Velocity:
        """The motion the person would like, from what they see now."""
        p = self.params
        self._sight += _wander(self._sight, p.sight_error, p.sight_wander, dt, self._random.normal())
        self._mood += _wander(self._mood, p.speed_error, p.speed_wander, dt, self._random.normal())
        s = self._progress.update(pose.x, pose.y)
        if s >= self._trail.length:
            return STANDSTILL
        goal = self._trail.at(s + p.look_ahead)
        beyond = max(s + p.look_ahead - self._trail.length, 0.0)
        x, y = goal.x + beyond * math.cos(goal.heading), goal.y + beyond * math.sin(goal.heading)
        angle = math.atan2(y - pose.y, x - pose.x) - pose.heading + self._sight
        return Velocity(max(p.speed + self._mood, 0.0), p.steering * math.remainder(angle, math.tau))


class _Arm:
    """Spring and damper between a wanted and an actual speed, with a person behind who gives way, late."""

    def __init__(self, stiffness: float, damping: float, yielding: float, strongest: float, reaction: float) -> None:
        self._stiffness, self._damping, self._yielding, self._strongest = stiffness, damping, yielding, strongest
        self._stretch = 0.0
        self._felt = _Delay(reaction, 0.0)

    def step(self, want: float, have: float, dt: float) -> float:
        """The force or torque of the arm."""
        own = want - self._yielding * self._felt.step(self._stretch, dt)
        longest = self._strongest / self._stiffness
        self._stretch = min(max(self._stretch + (own - have) * dt, -longest), longest)
        force = self._stiffness * self._stretch + self._damping * (own - have)
        return min(max(force, -self._strongest), self._strongest)


class _Delay(Generic[T]):
    """A pure delay by a whole number of steps, found at the first one."""

    def __init__(self, seconds: float, initial: T) -> None:
        self._seconds, self._initial = seconds, initial
        self._line: deque[T] = deque()

    def step(self, value: T, dt: float) -> T:
        """Put in the newest, get what was put in ``seconds`` ago."""
        self._line.append(value)
        return self._line.popleft() if len(self._line) > round(self._seconds / dt) else self._initial


def _wander(value: V, deviation: float, time: float, dt: float, noise: V) -> V:
    """Change over dt of a random value that keeps this standard deviation and forgets over this time."""
    keep = math.exp(-dt / time)
    return (keep - 1) * value + deviation * math.sqrt(1 - keep * keep) * noise
