"""Walker and person together, as a robot's base sees them: a velocity command in, sensor messages out, every 10 ms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skytether.control.admittance import Velocity
from skytether.messages import (
    Header,
    JointState,
    Message,
    Odometry,
    Point,
    PoseWithCovariance,
    Time,
    Twist,
    TwistWithCovariance,
    Vector3,
    Wrench,
    WrenchStamped,
    quaternion_from_yaw,
)
from skytether.messages import Pose as PoseMessage

from .person import Person, PersonParams
from .trail import Pose, Trail
from .walker import Arms, Walker, WalkerParams

STEP = 0.01
"""Sampling time of the walker's electronics, s (thesis section 2.4)."""

_ODOMETRY_EVERY = 10
"""Steps between two messages of the walker's own odometry: 10 Hz."""

_WALKER, _PERSON = WalkerParams(), PersonParams()


@dataclass(frozen=True, slots=True)
class Sensors:
    """What the walker measured in one step.

    Attributes:
        force: Net wrench of both forearms about the middle of the handlebar, base frame: ``force.x = F_l + F_r`` [N],
            ``torque.z = (F_r - F_l) d / 2`` [N m].
        wheels: Accumulated angles [rad] and rates [rad/s] of ``left_wheel`` and ``right_wheel``.
        odom: The walker's own dead reckoning; every tenth step, from the first.
    """

    force: WrenchStamped
    wheels: JointState
    odom: Odometry | None

    def messages(self) -> list[tuple[str, Message]]:
        """Topic and message of each."""
        found: list[tuple[str, Message]] = [("force", self.force), ("wheels", self.wheels)]
        if self.odom is not None:
            found.append(("odom", self.odom))
        return found


class World:
    """The whole simulation; deterministic by its seed, whatever the clock says."""

    def __init__(
        self,
        trail: Trail,
        *,
        seed: int,
        walker: WalkerParams = _WALKER,
        person: PersonParams = _PERSON,
    ) -> None:
        """Person and walker stand at the trail's start."""
        # Independent streams: another walker meets the same person.
        of_walker, of_person = np.random.default_rng(seed).spawn(2)
        self.trail = trail
        self.walker = Walker(walker, of_walker)
        self.person = Person(person, trail, of_person)
        self._arms = Arms(0.0, 0.0)
        self._steps = 0

    @property
    def pose(self) -> Pose:
        """The walker's true pose."""
        return self.walker.pose

    @property
    def velocity(self) -> Velocity:
        """The walker's true velocity."""
        return self.walker.velocity

    @property
    def elapsed(self) -> float:
        """Simulated time, s."""
        return self._steps * STEP

    def step(self, now: float, command: Twist, *, walking: bool = True) -> Sensors:
        """Advance by ``STEP``.

        Args:
            now: Robot's clock [s]; only stamps the messages.
            command: Velocity that the motors are to reach.
            walking: False: the person stands at the walker and waits.
        """
        walker = self.walker
        walker.step(Velocity(command.linear.x, command.angular.z), self._arms, STEP)
        arms = self._arms = self.person.step(
            walker.pose, walker.velocity, walker.params.sensor_distance, STEP, walking=walking
        )
        due = self._steps % _ODOMETRY_EVERY == 0
        self._steps += 1
        stamp = Time.from_seconds(now)
        return Sensors(
            _force(walker.measure(arms), walker.params.sensor_distance, Header(stamp, "base_link")),
            JointState(
                Header(stamp),
                ("left_wheel", "right_wheel"),
                np.array(walker.wheels[:2]),
                np.array(walker.wheels[2:]),
            ),
            _odometry(walker, Header(stamp, "odom")) if due else None,
        )


def _force(arms: Arms, distance: float, header: Header) -> WrenchStamped:
    """Both forearms as one wrench."""
    torque = (arms.right - arms.left) * distance / 2
    return WrenchStamped(header, Wrench(Vector3(x=arms.left + arms.right), Vector3(z=torque)))


def _odometry(walker: Walker, header: Header) -> Odometry:
    x, y, heading = walker.odometry
    wheels, p = walker.wheels, walker.params
    left, right = wheels.left_rate * p.wheel_radius, wheels.right_rate * p.wheel_radius
    pose = PoseMessage(Point(x, y), quaternion_from_yaw(heading))
    twist = Twist(Vector3(x=(left + right) / 2), Vector3(z=(right - left) / p.track))
    return Odometry(header, "base_link", PoseWithCovariance(pose), TwistWithCovariance(twist))
