"""The virtual trail as anybody's nodes of ROS 2: one finds where the walker is, one guides it; nothing of ours in it.

A program for ``launch`` of a service with ``graph: ros2``. The law is the thesis's (equations 2.2 to 2.4), as in
`skytether_services.virtual_trail.guide`. Its parameters: the trail's pieces, and a file in which it keeps what it heard
and published.
"""

from __future__ import annotations

import itertools
import json
import math
import time
from collections import deque
from pathlib import Path
from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped, Twist, WrenchStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState

PERIOD_S = 0.02
KEPT = 1000
"""Messages that wait for a node that has no core now: what it loses itself is not what the tests ask."""
RADIUS, TRACK = 0.1, 0.55
"""Of and between the wheels [m]."""
MASS, DAMPING, MOST_LINEAR = 15.0, 60.0, 0.25
ANGULAR_MASS, ANGULAR_DAMPING, MOST_ANGULAR = 1.2, 6.0, 0.5
TORQUE_GAIN, SENSOR_DISTANCE, LATERAL_GAIN = 50.0, 0.5, 1.2
PREVIEW_M = ANGULAR_DAMPING / (TORQUE_GAIN * SENSOR_DISTANCE)
FILTER = -math.expm1(-math.tau * 3.0 * PERIOD_S)
"""Share of a new force: low pass at 3 Hz."""
END_RATE, END_CREEP = 0.8, 0.03
SILENT_S = 0.3
"""It says nothing from a force or a pose that is older."""
SPACING_M = 0.01

Pose = tuple[float, float, float]


class Diary:
    """Lines of JSON, each on the disk at once: the program may be killed, and the next one is another user."""

    def __init__(self, path: str) -> None:
        self._file = Path(f"{path}.{time.time_ns()}").open("w", buffering=1)  # noqa: SIM115
        self.note("began", time.time_ns())

    def note(self, *what: Any) -> None:
        print(json.dumps(what), file=self._file)


class Localizer(Node):
    """Dead reckoning by the wheels since the walker's last odometry."""

    def __init__(self, diary: Diary) -> None:
        super().__init__("localizer")
        self._diary = diary
        self._wheels: deque[tuple[int, float, float]] = deque(maxlen=200)
        self._pose: Pose | None = None
        self._poses = self.create_publisher(PoseStamped, "pose", KEPT)
        self.create_subscription(JointState, "wheels", self._roll, KEPT)
        self.create_subscription(Odometry, "odom", self._anchor, KEPT)

    def _roll(self, told: JointState) -> None:
        now = nanoseconds(told)
        self._diary.note("wheels", now)
        if self._wheels and now <= self._wheels[-1][0]:
            return
        angles = dict(zip(told.name, told.position, strict=True))
        self._wheels.append((now, angles["left_wheel"], angles["right_wheel"]))
        if self._pose is None:
            return
        self._pose = rolled(self._pose, *list(self._wheels)[-2:])
        pose = PoseStamped()
        pose.header.stamp = told.header.stamp
        pose.pose.position.x, pose.pose.position.y, heading = self._pose
        pose.pose.orientation.z, pose.pose.orientation.w = math.sin(heading / 2), math.cos(heading / 2)
        self._poses.publish(pose)

    def _anchor(self, told: Odometry) -> None:
        then = nanoseconds(told)
        self._diary.note("odom", then)
        if not self._wheels:
            return
        since = [sample for sample in self._wheels if sample[0] >= then]
        pose = told.pose.pose
        found = pose.position.x, pose.position.y, 2 * math.atan2(pose.orientation.z, pose.orientation.w)
        for before, after in itertools.pairwise(since):
            found = rolled(found, before, after)
        self._pose = found


class Guide(Node):
    """The person gives the pace by pushing; the walker is turned so that it stays on the trail."""

    def __init__(self, diary: Diary, trail: list[Pose]) -> None:
        super().__init__("guide")
        self._diary, self._trail = diary, trail
        self._at: int | None = None
        self._pose: tuple[float, Pose] | None = None
        self._force: tuple[float, float] | None = None
        self._filtered = self._linear = self._angular = 0.0
        self._wheels = self.create_publisher(Twist, "cmd_vel", KEPT)
        self.create_subscription(WrenchStamped, "force", self._feel, KEPT)
        self.create_subscription(PoseStamped, "pose", self._stand_at, KEPT)
        self.create_timer(PERIOD_S, self._step)

    def _feel(self, told: WrenchStamped) -> None:
        self._diary.note("force", nanoseconds(told))
        self._force = time.monotonic(), told.wrench.force.x

    def _stand_at(self, told: PoseStamped) -> None:
        x, y, turn = told.pose.position.x, told.pose.position.y, told.pose.orientation
        self._pose = time.monotonic(), (x, y, 2 * math.atan2(turn.z, turn.w))

    def _step(self) -> None:
        if self._pose is None or self._force is None or not self._wheels.get_subscription_count():
            return
        (felt_at, force), (seen_at, pose) = self._force, self._pose
        if time.monotonic() - min(felt_at, seen_at) > SILENT_S:
            self._filtered = self._linear = self._angular = 0.0
            return
        self._at = nearest(self._trail, pose, self._at)
        left = (len(self._trail) - 1 - self._at) * SPACING_M
        self._filtered += FILTER * (force / 2 - self._filtered)
        self._linear += PERIOD_S * (self._filtered - DAMPING * self._linear) / MASS
        self._linear = min(max(self._linear, 0.0), MOST_LINEAR, max(END_RATE * left, END_CREEP) if left > 0 else 0.0)
        torque = TORQUE_GAIN * self._linear * SENSOR_DISTANCE * math.tanh(self._error(pose, self._at))
        self._angular += PERIOD_S * (torque - ANGULAR_DAMPING * self._angular) / ANGULAR_MASS
        self._angular = min(max(self._angular, -MOST_ANGULAR), MOST_ANGULAR) if self._linear > 0 else 0.0
        told = Twist()
        told.linear.x, told.angular.z = self._linear, self._angular
        self._diary.note("cmd_vel", self._linear, self._angular)
        self._wheels.publish(told)

    def _error(self, pose: Pose, at: int) -> float:
        x, y, heading = self._trail[at]
        aside = math.cos(heading) * (pose[1] - y) - math.sin(heading) * (pose[0] - x)
        ahead = self._trail[min(at + round(PREVIEW_M / SPACING_M), len(self._trail) - 1)][2]
        error = ahead - math.atan(LATERAL_GAIN * aside) - pose[2]
        return math.remainder(error, math.tau)


def nanoseconds(message: Any) -> int:
    """Of a message's stamp."""
    return int(message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec)


def rolled(pose: Pose, before: tuple[int, float, float], after: tuple[int, float, float]) -> Pose:
    """The pose after the wheels have turned."""
    left, right = RADIUS * (after[1] - before[1]), RADIUS * (after[2] - before[2])
    return moved(pose, (left + right) / 2, (right - left) / TRACK)


def moved(pose: Pose, way: float, turn: float) -> Pose:
    """The pose after a short arc."""
    x, y, heading = pose
    middle = heading + turn / 2
    return x + way * math.cos(middle), y + way * math.sin(middle), heading + turn


def trail_of(lengths: list[float], curvatures: list[float]) -> list[Pose]:
    """Its points, each centimetre."""
    points: list[Pose] = [(0.0, 0.0, 0.0)]
    for length, curvature in zip(lengths, curvatures, strict=True):
        for _ in range(round(length / SPACING_M)):
            points.append(moved(points[-1], SPACING_M, SPACING_M * curvature))
    return points


def nearest(trail: list[Pose], pose: Pose, last: int | None) -> int:
    """The point beside the walker: half a metre ahead of the last at most, and not behind it."""
    near = range(len(trail)) if last is None else range(last, min(last + 50, len(trail)))
    return min(near, key=lambda i: math.dist(trail[i][:2], pose[:2]))


def main() -> None:
    """Be both nodes until the service ends."""
    rclpy.init()
    given = rclpy.create_node("trail")
    diary = Diary(given.declare_parameter("diary", "").value)
    lengths = list(given.declare_parameter("lengths", [1.0]).value)
    trail = trail_of(lengths, list(given.declare_parameter("curvatures", [0.0]).value))
    executor = SingleThreadedExecutor()
    nodes = Localizer(diary), Guide(diary, trail)
    for node in nodes:
        executor.add_node(node)
    topics = "force", "wheels", "odom", "pose"
    while not all(nodes[1].count_publishers(topic) for topic in topics):
        executor.spin_once(0.05)
    diary.note("joined")
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        diary.note("ended")


if __name__ == "__main__":
    main()
