"""Following in front in the simulated hall: legs, choice of the operator and law, over a link, in made-up time.

No processes, and no pictures unless a test brings them: the angle of the face is the true one with noise.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable
from itertools import count

import numpy as np

from skytether.lab.trail import Pose
from skytether.lab.world.lemniscate import Lemniscate
from skytether.lab.world.operator import Operator, OperatorParams
from skytether.lab.world.plan import hall
from skytether.lab.world.robot import RearParams, RobotParams
from skytether.lab.world.simulation import TICK, Robot, Simulation
from skytether.messages import LaserScan, Twist, Vector3
from skytether_services.follow_in_front.formation import Formation, FormationParams, State
from skytether_services.follow_in_front.operator import Operator as SeenOperator
from skytether_services.follow_in_front.operator import OperatorChoice, OperatorState
from skytether_services.follow_in_front.tracker import PeopleTracker

REAR = RearParams()
_STEP = 10
"""Ticks between steps of the law, 10 Hz."""
_LAG = 0.05
"""Of the wheels, s; half of it counts for the prediction."""


class Loop:
    """One robot, one operator, one service's algorithms.

    Attributes:
        world: The hall.
        eyes: Where the face points off the robot's heading, by a picture taken now [rad]; None: no face is seen.
        seen: The operator as last seen.
        curve: On its floor.
        path: Of the robot's middle, ten points a second [m], from the first movement on.
        states: The law's, step by step.
        choices: The choice of the operator's, scan by scan.
        errors: How far the one who is followed was seen from where the operator was, scan by scan [m].
        aside: Direction of the operator's face off the camera's axis, scan by scan [rad].
        begun: When the robot moved first [s].
    """

    def __init__(
        self,
        seed: int,
        *,
        round_trip: float = 0.0,
        face_rate: float = 15.0,
        face_noise: float = 2.0,
        gain: float = FormationParams().steering_gain,
    ) -> None:
        """``face_noise``: standard deviation in degrees; ``gain``: of the robot, as the operator is used to it [1/s].

        Without pictures the robot sees the true angle, and answers as its law says.
        """
        self.curve = Lemniscate()
        self.operator = Operator(self.curve, seed, OperatorParams(gain=gain))
        self.world = Simulation(hall(), seed=seed, params=RobotParams(rear=REAR), operator=self.operator)
        self._half, self._rate, self._noise = round_trip / 2, face_rate, math.radians(face_noise)
        self._random = np.random.default_rng(seed + 1000)
        self._tracker, self._choice = PeopleTracker(), OperatorChoice()
        self._formation = Formation(FormationParams(lead=self._half + _LAG))
        self._under_way: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()
        self._face_at = -math.inf
        self._command = Twist()
        self.path: list[tuple[float, float]] = []
        self.states: list[State] = []
        self.choices: list[OperatorState] = []
        self.errors: list[float] = []
        self.aside: list[float] = []
        self.begun = math.nan
        self.eyes: Callable[[], float | None] = self._true_face
        self.seen: SeenOperator | None = None

    @property
    def robot(self) -> Robot:
        return self.world.robots[0]

    @property
    def picked(self) -> int:
        """So many operators were picked."""
        return self._choice.picked

    def run(self, seconds: float) -> bool:
        """Whether the round was done in this time."""
        while self.world.time < seconds and not self.operator.done:
            self._tick()
        return self.operator.done

    def go_on(self, seconds: float) -> None:
        """Whatever the operator does."""
        for _ in range(round(seconds / TICK)):
            self._tick()

    def _tick(self) -> None:
        self.robot.write(self._command)
        odometry = self.robot.odometer
        found = self.world.tick()[0]
        now = self.world.time
        for _, message in found:
            if isinstance(message, LaserScan) and message.header.frame_id == "rear_laser":
                pose, truth = odometry.pose, self._truth()
                self._send(lambda s=message, p=pose, t=truth, at=now: self._scan(s, p, t, at))
        if math.floor(now * self._rate + 1e-9) > math.floor((now - TICK) * self._rate + 1e-9):
            angle = self.eyes()
            if angle is not None:
                self._send(lambda a=angle, at=now: self._face(a, at))
        self._deliver(now)
        if self.world.ticks % _STEP == 0:
            command = self._formation.step(now)
            self.states.append(command.state)
            velocity = command.velocity
            twist = Twist(Vector3(x=velocity.linear), Vector3(z=velocity.angular))
            self._send(lambda t=twist: setattr(self, "_command", t))
            self._deliver(now)
            if self.robot.motion.forward > 0.02 and math.isnan(self.begun):
                self.begun = now
            if not math.isnan(self.begun):
                self.path.append(self.robot.pose[:2])

    def _send(self, arrive: Callable[[], None]) -> None:
        heapq.heappush(self._under_way, (self.world.time + self._half, next(self._order), arrive))

    def _deliver(self, now: float) -> None:
        while self._under_way and self._under_way[0][0] <= now + 1e-9:
            heapq.heappop(self._under_way)[2]()

    def _scan(self, scan: LaserScan, pose: Pose, truth: tuple[float, float], at: float) -> None:
        x, y, heading = pose
        laser = (x + REAR.laser_x * math.cos(heading), y + REAR.laser_x * math.sin(heading), heading + math.pi)
        self._tracker.step(
            scan.ranges, scan.angle_min, scan.angle_increment, (scan.range_min, scan.range_max), laser, at
        )
        face = math.atan2(truth[1], -truth[0]) if at - self._face_at < 0.5 else None
        seen = self._choice.step(self._tracker.tracks, pose, at, face=face)
        self.choices.append(self._choice.choice)
        self.aside.append(math.atan2(truth[1], REAR.camera_x - truth[0]))
        self.seen = seen
        if seen is not None:
            self.errors.append(math.dist((seen.x, seen.y), truth))
            self._formation.legs(seen.x, seen.y, seen.vx, seen.vy, seen.seen_at)

    def _true_face(self) -> float:
        return self.operator.face_angle(self.robot.pose) + self._noise * float(self._random.normal())

    def _face(self, angle: float, at: float) -> None:
        self._face_at = at
        self._formation.face(angle, at)

    def _truth(self) -> tuple[float, float]:
        """Where the operator is in the robot's frame [m]."""
        x, y, heading = self.robot.pose
        dx, dy = self.operator.pose.x - x, self.operator.pose.y - y
        cos, sin = math.cos(heading), math.sin(heading)
        return cos * dx + sin * dy, cos * dy - sin * dx
