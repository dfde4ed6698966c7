"""The simulated smart walker as nodes of real ROS 2: a base in one process, the forearms' sensors in another."""

from __future__ import annotations

from pathlib import Path

from ros2_nodes import Node, Ros2Nodes

from skytether.lab.measures import Judge, Measures, Sample
from skytether.lab.netns import Namespace
from skytether.lab.trail import Segments, Trail
from skytether.robot.control.command import Source

_BASE = """
sys.path.insert(0, PLATFORM)
import math
import numpy as np
from geometry_msgs.msg import Twist, Vector3
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from skytether.control.admittance import Velocity
from skytether.lab.person import Person, PersonParams
from skytether.lab.trail import Trail
from skytether.lab.walker import Arms, Walker, WalkerParams

STEP, MOST = 0.01, 20  # seconds; steps at once after a time without a core: more would be a jump
of_walker, of_person = np.random.default_rng(1).spawn(2)
walker, person = Walker(WalkerParams(), of_walker), Person(PersonParams(), Trail(TRAIL), of_person)
arms = Arms(0.0, 0.0)
command, heard = Twist(), 0
on, walking, began, steps = False, False, 0.0, 0

def drive(twist):
    global command, heard
    command, heard = twist, heard + 1
node.create_subscription(Twist, "cmd_vel", drive, 10)
felt = node.create_publisher(Vector3, "forearms", 10)
wheels = node.create_publisher(JointState, "wheels", 10)
odom = node.create_publisher(Odometry, "odom", 10)
sent = {"wheels": 0, "odom": 0}

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
        stamp = node.get_clock().now().to_msg()
        measured = walker.measure(arms)
        felt.publish(Vector3(x=measured.left, y=measured.right))
        state = JointState(name=["left_wheel", "right_wheel"])
        state.header.stamp = stamp
        state.position, state.velocity = list(walker.wheels[:2]), list(walker.wheels[2:])
        wheels.publish(state)
        sent["wheels"] += 1
        if steps % 10 == 0:
            report(stamp)
        if walking and steps % 4 == 0:
            say(["at", steps * STEP, walker.pose.x, walker.pose.y])
        steps += 1

def report(stamp):
    x, y, heading = walker.odometry
    told = Odometry(child_frame_id="base_link")
    told.header.stamp, told.header.frame_id = stamp, "odom"
    told.pose.pose.position.x, told.pose.pose.position.y = x, y
    told.pose.pose.orientation.z, told.pose.pose.orientation.w = math.sin(heading / 2), math.cos(heading / 2)
    told.twist.twist.linear.x, told.twist.twist.angular.z = walker.velocity
    odom.publish(told)
    sent["odom"] += 1
node.create_timer(STEP, turn)

def obey(word):
    global on, walking, began
    if word == "on":
        on, began = True, time.monotonic() - steps * STEP
    elif word == "walk":
        walking = True
    elif word == "off":
        on = False
        time.sleep(0.1)
        say(["sent", dict(sent), heard])
    elif word == "joined":
        while not (wheels.get_subscription_count() and odom.get_subscription_count()):
            time.sleep(0.05)
        say(["joined"])
threading.Thread(target=lambda: [obey(line.strip()) for line in sys.stdin], daemon=True).start()
"""
_FOREARMS = """
from geometry_msgs.msg import Vector3, WrenchStamped

force = node.create_publisher(WrenchStamped, "force", 10)
sent = 0
def both(felt):
    global sent
    told = WrenchStamped()
    told.header.stamp, told.header.frame_id = node.get_clock().now().to_msg(), "base_link"
    told.wrench.force.x, told.wrench.torque.z = felt.x + felt.y, (felt.y - felt.x) * DISTANCE / 2
    force.publish(told)
    sent += 1
node.create_subscription(Vector3, "forearms", both, qos(depth=100))
def obey(word):
    if word == "joined":
        while not force.get_subscription_count():
            time.sleep(0.05)
        say(["joined"])
    else:
        say(["sent", {"force": sent}])
threading.Thread(target=lambda: [obey(line.strip()) for line in sys.stdin], daemon=True).start()
"""


class Ros2Walker:
    """A base, its forearms and the person; all of it stands still until told.

    Args:
        nodes: The domain.
        namespace: Of both nodes and their topics.
        where: The robot's network.
        trail: What the person sees.
    """

    def __init__(self, nodes: Ros2Nodes, namespace: str, where: Namespace | None, trail: Segments) -> None:
        self._nodes, self._namespace, self._where = nodes, namespace, where
        self.trail = Trail(trail)
        self.judge = Judge(self.trail)
        self.heard = 0
        """Velocities that the base was told, once it is off."""
        before = f"PLATFORM, TRAIL = {str(Path(__file__).parents[2] / 'platform')!r}, {list(trail)!r}\n"
        self._base = nodes.start(before + _BASE, "base", namespace, where)
        self._forearms = self._start_forearms()

    def _start_forearms(self) -> Node:
        return self._nodes.start("DISTANCE = 0.5\n" + _FOREARMS, "forearms", self._namespace, self._where)

    def wait_until_joined(self) -> None:
        """Until all its topics are subscribed."""
        for node in (self._base, self._forearms):
            node.tell("joined")
            while node.next() != ["joined"]:
                pass

    def begin(self) -> None:
        """Measure and publish; the person stands."""
        self._base.tell("on")

    def walk(self) -> None:
        """The person walks."""
        self._base.tell("walk")

    def lose_forearms(self) -> None:
        """Their node is killed."""
        self._forearms.close()

    def start_forearms(self) -> None:
        """A new node of the same name."""
        self._forearms = self._start_forearms()

    def look(self) -> float:
        """How far it is along the trail [m]."""
        for _, at, x, y in self._base.all():
            self.judge.add(Sample(at, x, y, Source.CLOUD))
        return self.judge.s

    def park(self) -> dict[str, int]:
        """Measure nothing any more; how many messages were published, by topic."""
        self._base.tell("off")
        while (said := self._base.next())[0] != "sent":
            pass
        self.heard = said[2]
        self._forearms.tell("sent")
        told: dict[str, int] = {**said[1], **self._forearms.next()[1]}
        return told

    def result(self) -> Measures:
        """Of the walk."""
        return self.judge.result()
