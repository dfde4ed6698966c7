"""A recording of the world as an MCAP file with ROS 2 messages, which Foxglove opens.

Beside what the robots measure: ``/map``, ``/goals``, where robots truly are (``/truth``), people and contacts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from mcap.writer import CompressionType, Writer

from skytether.lab.trail import Pose
from skytether.messages import (
    ColorRGBA,
    Header,
    Marker,
    MarkerArray,
    Message,
    Odometry,
    Point,
    PoseStamped,
    PoseWithCovariance,
    String,
    TFMessage,
    Time,
    Transform,
    TransformStamped,
    Twist,
    TwistWithCovariance,
    Vector3,
    definition_of,
    encode,
    hash_of,
    quaternion_from_yaw,
)
from skytether.messages import Path as PathMessage
from skytether.messages import Pose as PoseMessage

from .occupancy import Occupancy
from .simulation import Readings, Robot, Simulation

_EVERY = 10
"""Ticks between messages about truth, people and contacts."""
_CYLINDER = 3
"""Type of a `Marker`."""
_COLOURS = {True: ColorRGBA(0.8, 0.3, 0.0, 1.0), False: ColorRGBA(0.0, 0.4, 0.7, 1.0)}


class McapWriter:
    """A file with messages of any topics, in ROS 2's encoding. A context manager: leaving closes it.

    Raises:
        OSError: The file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._stream: BinaryIO = path.open("wb")
        self._writer = Writer(self._stream, compression=CompressionType.ZSTD)
        self._writer.start("ros2")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def write(self, topic: str, message: Message, at: float) -> None:
        """Append a message of a moment [s]."""
        kind = message.TYPE
        if kind not in self._schemas:
            definition = definition_of(kind, "cdr").encode()
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", definition)
        if topic not in self._channels:
            metadata = {"topic_type_hash": hash_of(kind, "cdr")}
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[kind], metadata)
        nanoseconds = round(at * 1e9)
        self._writer.add_message(self._channels[topic], nanoseconds, encode(message, "cdr"), nanoseconds)

    def close(self) -> None:
        """Write the summary."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()

    def __enter__(self) -> McapWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class WorldRecorder:
    """Observes a simulation tick by tick; see `skytether.lab.world.agent.Observer`.

    The first robot's topics have no prefix, those of the others ``/robot_1`` and so on.
    """

    def __init__(self, writer: McapWriter) -> None:
        self._writer = writer
        self._begun = False
        self._contacts = 0

    def __call__(self, simulation: Simulation, found: Sequence[Readings]) -> None:
        """Record the tick that was just made."""
        at = simulation.time
        stamp = Time.from_seconds(at)
        if not self._begun:
            self._begun = True
            self._writer.write("/map", Occupancy(simulation.plan).message(stamp), at)
            self._writer.write("/goals", _goals(simulation.plan.goals, stamp), at)
        for robot, readings in zip(simulation.robots, found, strict=True):
            for topic, message in readings:
                self._writer.write(_name(robot, topic), message, at)
        if simulation.ticks % _EVERY == 0:
            for robot in simulation.robots:
                self._writer.write(_name(robot, "truth"), _truth(robot, stamp), at)
            # Where odometry began, as truth has it: so all is seen on the map. Frames are the first robot's.
            self._writer.write("/tf", _map_to_odom(simulation.robots[0], stamp), at)
            self._writer.write("/people", _people(simulation, stamp), at)
        contacts = simulation.contacts
        for contact in contacts[self._contacts :]:
            text = f"robot {contact.robot} touches {contact.kind} {contact.name} at {contact.began:.2f} s"
            self._writer.write("/contacts", String(text), at)
        self._contacts = len(contacts)


def _name(robot: Robot, topic: str) -> str:
    # All robots' frames are named alike: their transforms would contradict each other on one topic.
    return f"/{topic}" if robot.index == 0 else f"/robot_{robot.index}/{topic}"


def _goals(goals: Sequence[Pose], stamp: Time) -> PathMessage:
    header = Header(stamp, "map")
    return PathMessage(header, tuple(PoseStamped(header, _pose(goal)) for goal in goals))


def _pose(pose: Pose) -> PoseMessage:
    return PoseMessage(Point(pose.x, pose.y), quaternion_from_yaw(pose.heading))


def _truth(robot: Robot, stamp: Time) -> Odometry:
    twist = Twist(Vector3(robot.motion.forward, robot.motion.left), Vector3(z=robot.motion.turning))
    return Odometry(
        Header(stamp, "map"), "base_link", PoseWithCovariance(_pose(robot.pose)), TwistWithCovariance(twist)
    )


def _map_to_odom(robot: Robot, stamp: Time) -> TFMessage:
    """What a perfect localisation would say."""
    told, truth = robot.odometer.pose, robot.pose
    turn = truth.heading - told.heading
    cos, sin = math.cos(turn), math.sin(turn)
    x, y = truth.x - (cos * told.x - sin * told.y), truth.y - (sin * told.x + cos * told.y)
    transform = Transform(Vector3(x, y), quaternion_from_yaw(turn))
    return TFMessage((TransformStamped(Header(stamp, "map"), "odom", transform),))


def _people(simulation: Simulation, stamp: Time) -> MarkerArray:
    markers = []
    for name, stance in zip(simulation.names, simulation.stances, strict=True):
        for part, (x, y) in enumerate(stance):
            trunk = part == 2
            size = Vector3(0.4, 0.4, 0.7) if trunk else Vector3(0.12, 0.12, 0.85)
            markers.append(
                Marker(
                    header=Header(stamp, "map"),
                    ns=name,
                    id=part,
                    type=_CYLINDER,
                    pose=PoseMessage(Point(x, y, 1.2 if trunk else 0.425)),
                    scale=size,
                    color=_COLOURS[trunk],
                )
            )
    return MarkerArray(tuple(markers))
