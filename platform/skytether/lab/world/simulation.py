"""The world in motion: robots that are driven, people who walk, sensors that look, contacts that count.

Deterministic by its seed, and as fast as the machine allows: whoever wants real time calls `Simulation.tick` in step
with a clock, see `agent`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.lab.trail import Pose
from skytether.messages import CompressedImage, Header, LaserScan, Message, Odometry, Range, TFMessage, Time, Twist

from .contacts import Contact, Judge, Touched
from .model import LEGS, PHYSICS_STEP, WorldError, compile_model, load_mujoco
from .operator import NAME as OPERATOR
from .operator import Operator
from .people import Person, Stance
from .plan import Plan
from .robot import Drive, Motion, Odometer, RobotParams
from .sensors import Eyes, odometry, transforms

TICK = 0.01
"""What one `Simulation.tick` lasts, s."""
SUBSTEPS = round(TICK / PHYSICS_STEP)

SCAN_EVERY, ODOMETRY_EVERY, SONAR_EVERY, REAR_SCAN_EVERY = 12, 10, 10, 10
"""Ticks between messages; those of /tf come each tick. Periods of Tables 2 and 4 of the thesis: 120, 100 and 10 ms."""

REAR_SCAN, CAMERA = "rear_scan", "camera/compressed"
"""Topics of a robot that has them. Pictures are taken by `camera.Camera`, not by the simulation."""

MAX_ROBOTS = 4
_PARAMS = RobotParams()

Readings = list[tuple[str, Message]]
"""Topics and messages of one robot."""

Floats = NDArray[np.float64]


class State(NamedTuple):
    """Where everything is: what a camera needs to know, as MuJoCo keeps it, at a time of the robots' clock."""

    stamp: Time
    qpos: Floats
    mocap_pos: Floats
    mocap_quat: Floats


class Robot:
    """One of the robots. Made by `Simulation`.

    Attributes:
        index: Its number.
        pose: True pose.
        motion: True velocity.
        distance: Way covered so far [m].
        scan: The newest; None: there was none yet.
        odometer: Its dead reckoning.
    """

    def __init__(
        self,
        index: int,
        start: Pose,
        eyes: Eyes,
        rear_eyes: Eyes,
        params: RobotParams,
        random: np.random.Generator,
    ) -> None:
        self.index = index
        self.pose = start
        self.motion = Motion(0.0, 0.0, 0.0)
        self.distance = 0.0
        self.scan: LaserScan | None = None
        self.odometer = Odometer(params, random)
        self.drive = Drive(params)
        self.eyes, self.rear_eyes = eyes, rear_eyes
        self._params = params
        self._command = Twist()
        self._silent = math.inf

    @staticmethod
    def topics(params: RobotParams = _PARAMS) -> dict[str, type[Message]]:
        """What a robot measures, by name."""
        sonars = {f"sonar_{index}": Range for index in range(len(params.sonar_angles))}
        rear: dict[str, type[Message]] = {REAR_SCAN: LaserScan, CAMERA: CompressedImage} if params.rear else {}
        return {"tf": TFMessage, "odom": Odometry, "scan": LaserScan, **sonars, **rear}

    def write(self, twist: Twist) -> None:
        """Command a velocity; the motors stop when none comes for `RobotParams.timeout`."""
        self._command = twist
        self._silent = 0.0

    def obey(self, dt: float) -> None:
        """Follow the command for dt seconds, or the standstill after it."""
        heard = self._silent <= self._params.timeout
        self._silent += dt
        twist = self._command if heard else Twist()
        self.drive.ramp(twist.linear.x, twist.angular.z, dt)

    def moved(self, pose: Pose, motion: Motion, dt: float) -> None:
        """Take over where the physics brought it."""
        way, turn = way_and_turn(self.pose, pose)
        self.odometer.roll(way, turn, dt)
        self.distance += math.dist(self.pose[:2], pose[:2])
        self.pose, self.motion = pose, motion

    def read(self, ticks: int, stamp: Time) -> Readings:
        """What it measures in this tick."""
        prefix, found = "", Readings()
        pose = self.odometer.pose
        found.append(("tf", transforms(pose, self._params, stamp, prefix)))
        if ticks % ODOMETRY_EVERY == 0:
            found.append(("odom", odometry(pose, self.odometer.motion, stamp, prefix)))
        if ticks % SCAN_EVERY == 0:
            self.scan = self.eyes.scan(self.pose, Header(stamp, f"{prefix}laser"), SCAN_EVERY * TICK)
            found.append(("scan", self.scan))
        if ticks % SONAR_EVERY == 0:
            found += [(f"sonar_{i}", r) for i, r in enumerate(self.eyes.sonars(self.pose, stamp))]
        if self._params.rear is not None and ticks % REAR_SCAN_EVERY == 0:
            header = Header(stamp, f"{prefix}rear_laser")
            found.append((REAR_SCAN, self.rear_eyes.rear_scan(self.pose, header, REAR_SCAN_EVERY * TICK)))
        return found


class Simulation:
    """A plan, alive.

    Args:
        plan: What stands there.
        seed: Of all noise.
        robots: How many; each has its start in the plan.
        rounds: How many of the plan's rounds are walked: people beyond those who are always there.
        params: Of the robots.
        operator: Who walks behind the first robot.

    Attributes:
        stances: Where people are, in the order of `names`.

    Raises:
        WorldError: MuJoCo is missing, or the plan has no places for so many.
    """

    def __init__(
        self,
        plan: Plan,
        *,
        seed: int,
        robots: int = 1,
        rounds: int = 0,
        params: RobotParams = _PARAMS,
        operator: Operator | None = None,
    ) -> None:
        places = min(len(plan.starts), MAX_ROBOTS)
        if not 1 <= robots <= places:
            raise WorldError(f"the plan {plan.name} has places for 1 to {places} robots, not for {robots}")
        if not 0 <= rounds <= len(plan.rounds):
            raise WorldError(
                f"the plan {plan.name} has rounds for 0 to {len(plan.rounds)} more people, not for {rounds}"
            )
        self.plan, self.params, self.seed = plan, params, seed
        walks = (*plan.people, *plan.rounds[:rounds])
        self.people = tuple(Person(walk) for walk in walks)
        self.operator = operator
        self.names = (*(walk.name for walk in walks), *([OPERATOR] if operator else []))
        self._stamp = Time()
        self.stances: tuple[Stance, ...] = ()
        self.ticks = 0
        self._judge = Judge()
        self._mujoco = load_mujoco()
        self._model = compile_model(plan, walks, robots, params, OPERATOR if operator else None)
        self._data = self._mujoco.MjData(self._model)
        self._kinds = self._geoms()
        self._mocap = [[self._mocap_of(f"{name}-{part}") for part in (*LEGS, "trunk")] for name in self.names]
        self._head = self._mocap_of(f"{OPERATOR}-head") if operator else -1
        # Independent streams: a robot's noise is the same, whoever else is there, and whatever else it has.
        streams = np.random.default_rng(seed).spawn(3 * MAX_ROBOTS)
        self.robots = tuple(
            Robot(
                index,
                plan.starts[index],
                self._eyes(index, streams[2 * index]),
                self._eyes(index, streams[2 * MAX_ROBOTS + index]),
                params,
                streams[2 * index + 1],
            )
            for index in range(robots)
        )
        for robot in self.robots:
            self._put(robot.index, robot.pose)
        self._walk(0.0)
        self._mujoco.mj_forward(self._model, self._data)

    @property
    def model(self) -> Any:
        """The ``MjModel``."""
        return self._model

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.ticks * TICK

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """All so far, in the order in which they began."""
        return tuple(self._judge.contacts)

    def tick(self, now: float | None = None) -> list[Readings]:
        """Advance by `TICK`.

        Args:
            now: The robots' clock, which only stamps messages [s]; None: simulated time.

        Returns:
            What each robot measured, at the end of the tick.
        """
        for robot in self.robots:
            robot.obey(TICK)
        self._walk(TICK)
        for step in range(SUBSTEPS):
            for robot in self.robots:
                self._push(robot)
            self._mujoco.mj_step(self._model, self._data)
            if self._data.ncon:
                self._judge_contacts(self.time + (step + 1) * PHYSICS_STEP)
        self.ticks += 1
        # Positions are those of the end of the step, what was computed of them is not yet: rays need it.
        self._mujoco.mj_kinematics(self._model, self._data)
        self._stamp = stamp = Time.from_seconds(self.time if now is None else now)
        found = []
        for robot in self.robots:
            robot.moved(*self._state(robot.index), TICK)
            found.append(robot.read(self.ticks - 1, stamp))
        return found

    def state(self) -> State:
        """After the last tick; a copy."""
        data = self._data
        return State(self._stamp, data.qpos.copy(), data.mocap_pos.copy(), data.mocap_quat.copy())

    def place(self, index: int, pose: Pose) -> None:
        """Lift a robot and put it somewhere else; its odometry does not notice."""
        robot = self.robots[index]
        self._put(index, pose)
        self._data.qvel[3 * index : 3 * index + 3] = 0.0
        robot.pose, robot.motion = pose, Motion(0.0, 0.0, 0.0)
        robot.drive.stand()
        self._mujoco.mj_forward(self._model, self._data)

    def _eyes(self, index: int, random: np.random.Generator) -> Eyes:
        return Eyes(self._model, self._data, self._body(f"robot-{index}"), self.params, random)

    def _put(self, index: int, pose: Pose) -> None:
        self._data.qpos[3 * index : 3 * index + 3] = pose

    def _state(self, index: int) -> tuple[Pose, Motion]:
        x, y, heading = (float(v) for v in self._data.qpos[3 * index : 3 * index + 3])
        vx, vy, turning = (float(v) for v in self._data.qvel[3 * index : 3 * index + 3])
        cos, sin = math.cos(heading), math.sin(heading)
        return Pose(x, y, heading), Motion(cos * vx + sin * vy, cos * vy - sin * vx, turning)

    def _push(self, robot: Robot) -> None:
        pose, motion = self._state(robot.index)
        force = robot.drive.force(motion)
        cos, sin = math.cos(pose.heading), math.sin(pose.heading)
        first = 3 * robot.index
        self._data.qfrc_applied[first : first + 3] = (
            cos * force.forward - sin * force.left,
            sin * force.forward + cos * force.left,
            force.turning,
        )

    def _walk(self, dt: float) -> None:
        middles = [(robot.pose.x, robot.pose.y) for robot in self.robots]
        self.stances = tuple(person.step(middles, dt) for person in self.people)
        if self.operator is not None:
            first = self.robots[0]
            figure = self.operator.step(first.pose, first.motion, dt)
            self.stances += (figure.stance,)
            for body, heading, at in (
                (self._mocap[-1][2], figure.body, figure.stance.trunk),
                (self._head, figure.head, figure.stance.trunk),
            ):
                self._data.mocap_pos[body] = (*at, 0.0)
                self._data.mocap_quat[body] = (math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2))
        for bodies, stance in zip(self._mocap, self.stances, strict=True):
            for body, (x, y) in zip(bodies, stance, strict=True):
                self._data.mocap_pos[body] = (x, y, 0.0)

    def _judge_contacts(self, at: float) -> None:
        force = np.zeros(6)
        for index in range(self._data.ncon):
            contact = self._data.contact[index]
            first, second = self._kinds[contact.geom1], self._kinds[contact.geom2]
            self._mujoco.mj_contactForce(self._model, self._data, index, force)
            x, y, strength = float(contact.pos[0]), float(contact.pos[1]), float(np.linalg.norm(force[:3]))
            for (kind, _name, robot), (other, touched, _) in ((first, second), (second, first)):
                if kind is Touched.ROBOT:
                    self._judge.touch(robot, other, touched, at, x, y, strength)

    def _geoms(self) -> list[tuple[Touched, str, int]]:
        """Kind, name and robot of each geom, by its number."""
        walls = {box.name for box in self.plan.boxes if box.wall}
        people = {f"{name}-{part}": name for name in self.names for part in (*(f"{leg}-leg" for leg in LEGS), "body")}
        found: list[tuple[Touched, str, int]] = []
        for geom in range(self._model.ngeom):
            name = self._model.geom(geom).name
            body = self._model.body(int(self._model.geom_bodyid[geom]))
            if body.dofnum[0]:
                found.append((Touched.ROBOT, body.name, int(body.name.rpartition("-")[2])))
            elif name in people and body.id:
                found.append((Touched.PERSON, people[name], -1))
            else:
                found.append((Touched.WALL if name in walls else Touched.THING, name, -1))
        return found

    def _body(self, name: str) -> int:
        return int(self._model.body(name).id)

    def _mocap_of(self, name: str) -> int:
        return int(self._model.body(name).mocapid[0])


def way_and_turn(before: Pose, after: Pose) -> tuple[float, float]:
    """Way rolled forward [m] and angle turned [rad] from one pose to the next."""
    turn = after.heading - before.heading
    middle = before.heading + turn / 2
    way = (after.x - before.x) * math.cos(middle) + (after.y - before.y) * math.sin(middle)
    return way, turn
