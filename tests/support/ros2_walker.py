"""The simulated smart walker as nodes of real ROS 2: its base in one process, the sensors in another, and diaries.

What crosses is known one by one, on both sides: sensor messages by their stamps, velocities by what they say.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ros2_nodes import Node, Ros2Nodes

from skytether.lab.measures import Judge, Measures, Sample
from skytether.lab.netns import Namespace
from skytether.lab.trail import Segments, Trail
from skytether.robot.control.command import Source

_DIARY = """
diary = open(DIARY, "a", buffering=1)
def note(*what):
    print(json.dumps(what), file=diary)
"""
_BASE = """
sys.path.insert(0, PLATFORM)
import numpy as np
from geometry_msgs.msg import Twist
from std_msgs.msg import Float64MultiArray
from skytether.control.admittance import Velocity
from skytether.lab.person import Person, PersonParams
from skytether.lab.trail import Trail
from skytether.lab.walker import Arms, Walker, WalkerParams

STEP, MOST = 0.01, 20  # seconds; steps at once after a time without a core: more would be a jump
of_walker, of_person = np.random.default_rng(1).spawn(2)
walker, person = Walker(WalkerParams(), of_walker), Person(PersonParams(), Trail(TRAIL), of_person)
arms, command = Arms(0.0, 0.0), Twist()
on, walking, began, steps = False, False, 0.0, 0

def drive(twist):
    global command
    command = twist
    note("told", time.time_ns(), twist.linear.x, twist.angular.z)
# Wheels that have no core for a while lose nothing: what is asked is what others lose.
node.create_subscription(Twist, "cmd_vel", drive, qos(depth=1000))
felt = node.create_publisher(Float64MultiArray, "felt", qos(depth=1000))

def turn():
    global steps, arms
    if not on:
        return
    due = round((time.monotonic() - began) / STEP) + 1
    steps = max(steps, due - MOST)
    while steps < due:
        walker.step(Velocity(command.linear.x, command.angular.z), arms, STEP)
        distance = walker.params.sensor_distance
        arms = person.step(walker.pose, walker.velocity, distance, STEP, walking=walking)
        if steps % EACH == 0:
            fifth = float(steps % (5 * EACH) == 0)
            now = [*walker.measure(arms), *walker.wheels, *walker.odometry, *walker.velocity, fifth]
            felt.publish(Float64MultiArray(data=now))
        if walking and steps % 4 == 0:
            say(["at", steps * STEP, walker.pose.x, walker.pose.y])
        steps += 1
node.create_timer(STEP * EACH, turn)

def obey(word):
    global on, walking, began
    if word == "on":
        on, began = True, time.monotonic() - steps * STEP
    elif word == "walk":
        walking = True
    elif word == "off":
        on = False
threading.Thread(target=lambda: [obey(line.strip()) for line in sys.stdin], daemon=True).start()
"""
_SENSORS = """
import math
from geometry_msgs.msg import WrenchStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

kinds = {"force": WrenchStamped, "wheels": JointState, "odom": Odometry}
topics = {name: node.create_publisher(kind, name, 10) for name, kind in kinds.items()}
def tell(name, message, frame):
    message.header.stamp, message.header.frame_id = node.get_clock().now().to_msg(), frame
    note(name, message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec)
    topics[name].publish(message)
def both(felt):
    left, right, *wheels, x, y, heading, linear, angular, fifth = felt.data
    force = WrenchStamped()
    force.wrench.force.x, force.wrench.torque.z = left + right, (right - left) * DISTANCE / 2
    tell("force", force, "base_link")
    state = JointState(name=["left_wheel", "right_wheel"])
    state.position, state.velocity = wheels[:2], wheels[2:]
    tell("wheels", state, "")
    if fifth:
        odom = Odometry(child_frame_id="base_link")
        odom.pose.pose.position.x, odom.pose.pose.position.y = x, y
        odom.pose.pose.orientation.z, odom.pose.pose.orientation.w = math.sin(heading / 2), math.cos(heading / 2)
        odom.twist.twist.linear.x, odom.twist.twist.angular.z = linear, angular
        tell("odom", odom, "odom")
node.create_subscription(Float64MultiArray, "felt", both, qos(depth=1000))
def work():
    while not all(topic.get_subscription_count() for topic in topics.values()):
        time.sleep(0.05)
    say("joined")
threading.Thread(target=work, daemon=True).start()
"""


class Diary:
    """What nodes wrote down, in one file or in some of a name that begins so."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self, kind: str) -> list[list[Any]]:
        """All lines of this kind, each without it, oldest first."""
        files = sorted(self.path.parent.glob(f"{self.path.name}*"))
        lines = [line for file in files for line in file.read_text().splitlines(keepends=True)]
        # Of a line that is being written the rest comes later.
        mine = [line for line in lines if line.startswith(f'["{kind}"') and line.endswith("\n")]
        return [json.loads(line)[1:] for line in mine]

    def stamps(self, topic: str) -> list[int]:
        """Of a topic's messages [ns]."""
        return [stamp for (stamp,) in self.read(topic)]


class Ros2Walker:
    """A base, its sensors and the person; all of it stands still until told.

    Args:
        nodes: The domain.
        name: And the namespace of both nodes and their topics.
        where: The robot's network.
        trail: What the person sees.
        folder: For the diary.
        each: Steps of 10 ms for one message of force and wheels.

    Attributes:
        diary: Sensor messages that were published (``force``, ``wheels``, ``odom``: the stamp), and velocities that the
            wheels were ``told``: time [ns], linear, angular.
    """

    def __init__(
        self, nodes: Ros2Nodes, name: str, where: Namespace | None, trail: Segments, folder: Path, each: int
    ) -> None:
        self._nodes, self._namespace, self._where = nodes, f"/{name}", where
        self.judge = Judge(Trail(trail))
        self.diary = Diary(folder / f"{name}.diary")
        self._before = f"PLATFORM, TRAIL = {str(Path(__file__).parents[2] / 'platform')!r}, {list(trail)!r}\n"
        self._before += f"DIARY, DISTANCE, EACH = {str(self.diary.path)!r}, 0.5, {each}\n{_DIARY}"
        self._base = nodes.start(self._before + _BASE, "base", self._namespace, where)
        self._sensors = self._start("sensors", _SENSORS)

    def _start(self, name: str, code: str) -> Node:
        return self._nodes.start(self._before + code, name, self._namespace, self._where)

    def wait_until_joined(self) -> None:
        """Until all topics of the sensors are subscribed."""
        while "joined" not in self._sensors.heard:
            self._sensors.heard.append(self._sensors.next())

    def begin(self) -> None:
        """Measure and publish; the person stands."""
        self._base.tell("on")

    def walk(self) -> None:
        """The person walks."""
        self._base.tell("walk")

    def lose_sensors(self) -> None:
        """Their node is killed."""
        self._sensors.close()

    def start_sensors(self) -> None:
        """A new node of the same name."""
        self._sensors = self._start("sensors", _SENSORS)

    def look(self) -> float:
        """How far it is along the trail [m]."""
        for _, at, x, y in self._base.all():
            self.judge.add(Sample(at, x, y, Source.CLOUD))
        return self.judge.s

    def told(self) -> list[tuple[int, float, float]]:
        """Velocities that the wheels heard: time [ns], linear, angular."""
        return [tuple(line) for line in self.diary.read("told")]

    def park(self) -> None:
        """Measure nothing any more."""
        self._base.tell("off")

    def result(self) -> Measures:
        """Of the walk."""
        return self.judge.result()
