"""What ROS 2 expects of any node, of ours: time, parameters, lifecycle; and what becomes of it when ROS 2 fails it."""

import os
import signal
import time
from contextlib import suppress
from pathlib import Path

import pytest
from ros2_nodes import far_nodes, ros2_nodes, until

from skytether.messages import Twist, TwistStamped, Vector3, encode, hash_of
from skytether.robot.graphs.ros2.robot import Ros2Robot, Ros2RobotConfig
from skytether.ros.ros2.dialect import Endpoint, Kind, NodeName
from skytether.ros.ros2.lifecycle import states
from skytether.ros.ros2.native import node as native
from skytether.ros.ros2.native.node import RclpyNode
from skytether.ros.ros2.qos import Qos
from skytether.ros.ros2.sim_time import GraphClock

__all__ = ["far_nodes", "ros2_nodes"]
pytestmark = [pytest.mark.slow, pytest.mark.ros2]

WHEELS = Endpoint(Kind.PUBLISHER, "/cmd_vel", Twist.TYPE, hash_of(Twist.TYPE, "cdr"), Qos(depth=1))
SIMULATION = """
from rosgraph_msgs.msg import Clock
from geometry_msgs.msg import TwistStamped
from builtin_interfaces.msg import Time
clock = node.create_publisher(Clock, "/clock", qos(reliable=False, depth=1))
node.create_subscription(TwistStamped, "/cmd_vel", lambda m: say([m.header.stamp.sec, m.header.stamp.nanosec]), 10)
seconds = [0]
def tick():
    if seconds[0]:
        clock.publish(Clock(clock=Time(sec=seconds[0], nanosec=500_000_000)))
node.create_timer(0.05, tick)
def work():
    for line in sys.stdin:
        seconds[0] = int(line)
threading.Thread(target=work, daemon=True).start()
"""


def test_stamps_are_of_simulated_time_if_our_node_uses_it(ros2_nodes):
    """As ROS nodes do it: zero until /clock says something, then what it said last, also if it goes back."""
    peer = ros2_nodes.start(SIMULATION)
    config = Ros2RobotConfig(robot="walker", service="guide", namespace="/", cmd_vel_type=TwistStamped.TYPE)
    with RclpyNode(NodeName(), arguments=["-p", "use_sim_time:=true"]) as node:
        robot = Ros2Robot(config, node)
        until(lambda: node.sim_time and node.endpoints("/cmd_vel", Kind.SUBSCRIPTION), "our node and the peer")

        def stamps():
            robot.base.read(0.0)
            with suppress(ConnectionError):  # on a busy machine the node may seem to hang for a moment
                robot.base.write(Twist())
            return peer.all()

        until(lambda: [0, 0] in stamps(), "a stamp before there is a clock")
        for second in (1200, 30):
            peer.tell(str(second))
            until(lambda second=second: [second, 500_000_000] in stamps(), "the simulation's time")
        robot.close()


def test_the_parameter_can_be_changed_while_it_runs(ros2_nodes):
    """Our node has the parameters that every node has: they are listed, told, described and set through services."""
    peer = ros2_nodes.start(
        """
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
client = AsyncParameterClient(node, "/bot/skytether")
def then(future, what):
    future.add_done_callback(lambda f: say(what(f.result())))
def work():
    client.wait_for_services()
    then(client.list_parameters(), lambda r: ["list", "use_sim_time" in r.result.names])
    then(client.get_parameters(["use_sim_time"]), lambda r: ["get", r.values[0].bool_value])
    then(client.describe_parameters(["use_sim_time"]), lambda r: ["describe", r.descriptors[0].type])
    sys.stdin.readline()
    value = Parameter("use_sim_time", value=True)
    then(client.set_parameters([value]), lambda r: ["set", r.results[0].successful])
threading.Thread(target=work, daemon=True).start()
"""
    )
    with RclpyNode(NodeName("/bot", "skytether")) as node:
        assert {tuple(peer.next()) for _ in range(3)} == {("list", True), ("get", False), ("describe", 1)}
        clock = GraphClock(node, lambda: 5.0)
        until(lambda: node.nodes, "the peer")
        assert (node.sim_time, clock()) == (False, 5.0)
        peer.tell("set")
        assert peer.next() == ["set", True]
        until(lambda: node.sim_time, "the parameter to be seen")
        assert clock() == 0.0


def test_states_of_lifecycle_nodes_are_told(ros2_nodes):
    peer = ros2_nodes.start(
        """
from rclpy.lifecycle import LifecycleNode
node = LifecycleNode("camera", namespace="/front")
def work():
    for line in sys.stdin:
        getattr(node, "trigger_" + line.strip())()
        say(line.strip())
threading.Thread(target=work, daemon=True).start()
"""
    )
    ros2_nodes.start("", "plain")
    with RclpyNode() as node:
        until(lambda: states(node, 5.0) == {"/front/camera": "unconfigured"}, "the state")
        for step, state in (("configure", "inactive"), ("activate", "active")):
            peer.tell(step)
            assert peer.next() == step
            assert states(node, 10.0) == {"/front/camera": state}


def test_a_program_that_hangs_is_ended_and_started_again(ros2_nodes, monkeypatch):
    monkeypatch.setattr(native, "SILENT_S", 2.0)
    monkeypatch.setattr(native, "LEAVE_S", 0.2)
    peer = ros2_nodes.start(
        """
from geometry_msgs.msg import Twist
node.create_subscription(Twist, "/cmd_vel", lambda m: say(m.linear.x), 10)
"""
    )
    said = []
    with RclpyNode(say=said.append) as node:
        wheels = node.publish(WHEELS)
        until(lambda: wheels.put(encode(Twist())) and peer.all(), "the wheels")
        hung = node.pid
        os.kill(hung, signal.SIGSTOP)
        until(lambda: not wheels.put(encode(Twist())), "the loss to be seen")
        until(lambda: not Path(f"/proc/{hung}").exists(), "its end")
        until(lambda: len(said) == 2, "the node to be there again")
        peer.all()
        until(lambda: wheels.put(encode(Twist())) and peer.all(), "the wheels again")
    assert said == [
        "the program that is our ROS 2 node did not answer for 2 s and was ended; it is started again",
        "our ROS 2 node is there again",
    ]


def test_a_program_that_hangs_before_it_is_our_node_is_ended_and_started_again(ros2_nodes, monkeypatch):
    """As rclpy may at a lock in shared memory that somebody who was killed has left."""
    monkeypatch.setattr(native, "BEGIN_S", 2.0)
    monkeypatch.setattr(native, "LEAVE_S", 0.2)
    said = []
    with RclpyNode(say=said.append) as node:
        until(lambda: node.pid, "the program")
        hung = node.pid
        os.kill(hung, signal.SIGSTOP)
        until(lambda: said, "a word on that")
        monkeypatch.setattr(native, "BEGIN_S", 30.0)
        until(lambda: len(said) == 2, "the node to be there")
        assert not Path(f"/proc/{hung}").exists()
    assert said == [
        "the program that is our ROS 2 node did not answer for 2 s and was ended; it is started again",
        "our ROS 2 node is there again",
    ]


def test_a_program_that_cannot_be_started_is_named_and_tried_again(ros2_nodes, tmp_path):
    """As while a package is being upgraded, or no descriptor is left."""
    python, away = tmp_path / "python", tmp_path / "away"
    python.write_text(f'#!/bin/sh\nexec {ros2_nodes.python} "$@"\n')
    python.chmod(0o755)
    said = []
    with RclpyNode(python=str(python), say=said.append) as node:
        until(lambda: node.middleware, "the node")
        python.rename(away)
        os.kill(node.pid, signal.SIGKILL)
        until(lambda: len(said) == 2, "a word on that")
        away.rename(python)
        until(lambda: node.middleware, "the node again")
        assert not node.troubles
    assert said == [
        "the program that is our ROS 2 node ended by SIGKILL; it is started again",
        f"the program that is our ROS 2 node cannot be started: [Errno 2] No such file or directory: '{python}'; "
        "it is tried again",
        "our ROS 2 node is there again",
    ]


def test_no_velocity_waits_for_a_program_that_has_just_been_started(ros2_nodes):
    """Nor is the node called lost then, before it was there."""
    with RclpyNode() as node:
        wheels = node.publish(WHEELS, fresh_s=0.1)
        until(lambda: node.pid, "the program")
        while not node.middleware:
            assert not wheels.stuck
            assert not wheels.put(encode(Twist())) or node.middleware
        until(lambda: wheels.put(encode(Twist())), "the node")


def test_wheels_that_begin_to_listen_are_told_to_stand_first_and_hear_how_a_velocity_begins(ros2_nodes):
    """As after the program has died: DDS takes a second or two, in which a ramp would be over."""
    forward = Twist(linear=Vector3(x=0.5))
    with RclpyNode() as node:
        robot = Ros2Robot(Ros2RobotConfig("walker", "x", namespace="/"), node)
        until(lambda: node.wait_until_joined(0.1), "our node")

        def goes():
            robot.base.read(time.monotonic())
            try:
                robot.base.write(forward)
            except ConnectionError as error:
                return str(error) != "the wheels are told to stand until their node listens and hears us"
            return True

        robot.base.write(Twist())
        for _ in range(20):
            assert not goes(), "nobody listens"
            time.sleep(0.02)
        peer = ros2_nodes.start(
            """
from geometry_msgs.msg import Twist
node.create_subscription(Twist, "/cmd_vel", lambda m: say(m.linear.x), 10)
"""
        )
        until(goes, "the wheels to hear")
        until(lambda: (goes() and peer.heard.extend(peer.all())) or 0.5 in peer.heard, "the velocity")
        robot.close()
    assert peer.heard[0] == 0.0


def test_wheels_that_are_started_again_beside_a_recorder_hear_how_a_velocity_begins(ros2_nodes):
    """Somebody listens all the time, and is not the wheels."""
    listens = """
from geometry_msgs.msg import Twist
node.create_subscription(Twist, "/cmd_vel", lambda m: say(m.linear.x), 10)
"""
    stand, forward = encode(Twist()), encode(Twist(linear=Vector3(x=0.5)))
    with RclpyNode() as node:
        endpoint = Endpoint(Kind.PUBLISHER, "/cmd_vel", Twist.TYPE, hash_of(Twist.TYPE, "cdr"), Qos(reliable=True))
        wheels = node.publish(endpoint, fresh_s=0.1)

        def drive():
            time.sleep(0.03)
            return wheels.put(forward if wheels.heard else stand) and wheels.heard

        def listen(name):
            peer = ros2_nodes.start(listens, name=name)
            until(lambda: (drive() and peer.heard.extend(peer.all())) or 0.5 in peer.heard, f"{name} to hear")
            return peer

        base = listen("base")
        until(lambda: drive() and not wheels.unread_s, "the base to acknowledge")
        alone = wheels.renewed
        recorder = listen("recorder")
        renewed = wheels.renewed
        assert renewed > alone > 0, "so soon after the start it may be somebody who was told something before it"
        for end in (signal.SIGINT, signal.SIGKILL):
            base.process.send_signal(end)
            base.process.wait(10)
            at = time.monotonic()
            until(lambda at=at: drive() and time.monotonic() - at > 1.0)
            base = listen("base")
            # What goes to one who was killed reaches whoever has its port by then, before DDS knows of him.
            assert base.heard[0] == 0.0 or end == signal.SIGKILL
            until(lambda base=base: (drive() and base.heard.extend(base.all())) or 0.0 in base.heard, "a standstill")
        assert wheels.renewed >= renewed + 2
        assert 0.5 in recorder.heard
        wheels.close()


SWAPS = """
from geometry_msgs.msg import Twist
def listen(number):
    return node.create_subscription(Twist, "/cmd_vel", lambda m: say([number, m.linear.x]), 10)
def work():
    listening = listen(0)
    for number in range(1, 9):
        time.sleep(0.7)
        node.destroy_subscription(listening)
        listening = listen(number)
    time.sleep(0.7)
    say("done")
threading.Thread(target=work, daemon=True).start()
"""


class Drives:
    """Drives at 0.5 m/s, and tells who comes to stand first and how that begins, as guard and gate do."""

    def __init__(self, node, awaited=()):
        endpoint = Endpoint(
            Kind.PUBLISHER, "/cmd_vel", Twist.TYPE, hash_of(Twist.TYPE, "cdr"), Qos(reliable=True, depth=1)
        )
        self.wheels = node.publish(endpoint, fresh_s=0.1, awaited=awaited)
        self._speed = 0.0
        self._seen = None

    def turn(self):
        time.sleep(0.02)
        if self.wheels.renewed != self._seen or not self.wheels.heard or self.wheels.unread_s > 0.1:
            self._seen, self._speed = self.wheels.renewed, 0.0
        else:
            self._speed = min(self._speed + 0.02, 0.5)
        twist = encode(Twist(linear=Vector3(x=self._speed)))
        self.wheels.put(twist, renewed=self._seen, first=not self._speed)


def begins_at_standstill(heard):
    """Whoever acknowledges what he never got, as he joins late, hears the first steps.

    Whom DDS connects after our last look, and before it sends, hears that one velocity: on a busy machine, as this
    publisher has no real time.
    """
    return min(heard[:2]) <= 0.1


@pytest.mark.parametrize("awaited", [(), ("/base",)], ids=["anybody", "named"])
def test_a_subscription_that_is_made_anew_at_once_hears_a_standstill_first(ros2_nodes, awaited):
    """Within 2 ms: the number of those who listen was never another one."""
    with RclpyNode() as node:
        drives = Drives(node, awaited)
        base = ros2_nodes.start(SWAPS, name="base")
        until(lambda: drives.turn() or base.heard.extend(base.all()) or "done" in base.heard, "eight swaps")
        drives.wheels.close()
    heard = {}
    for number, x in (said for said in base.heard if said != "done"):
        heard.setdefault(number, []).append(x)
    assert len(heard) >= 8
    for xs in heard.values():
        assert begins_at_standstill(xs), heard
    assert max(x for number, x in (said for said in base.heard if said != "done") if number) >= 0.3


@pytest.mark.parametrize("awaited", [(), ("/base",)], ids=["anybody", "named"])
def test_another_process_of_a_node_that_still_listens_hears_a_standstill_first(ros2_nodes, awaited):
    """A rolling restart: its name is known later than that it listens."""
    listens = """
from geometry_msgs.msg import Twist
node.create_subscription(Twist, "/cmd_vel", lambda m: say(m.linear.x), 10)
"""
    with RclpyNode() as node:
        drives = Drives(node, awaited)
        base = ros2_nodes.start(listens, name="base")
        for _ in range(3):
            until(lambda base=base: drives.turn() or base.heard.extend(base.all()) or 0.5 in base.heard, "a velocity")
            after = ros2_nodes.start(listens, name="base")
            until(lambda after=after: drives.turn() or after.heard.extend(after.all()) or 0.5 in after.heard, "one")
            assert begins_at_standstill(after.heard), after.heard
            base.process.send_signal(signal.SIGINT)
            base.process.wait(10)
            base = after
        drives.wheels.close()


def test_when_ros_is_shut_down_under_our_node_that_is_named_and_it_comes_back(ros2_nodes, monkeypatch, tmp_path):
    """The context is shut down from within, as a signal handler of a library's would."""
    (tmp_path / "sitecustomize.py").write_text(
        f"""
import pathlib, threading, time
def wait():
    file = pathlib.Path({str(tmp_path / "now")!r})
    while not file.exists():
        time.sleep(0.05)
    file.unlink()
    import rclpy
    rclpy.shutdown()
threading.Thread(target=wait, daemon=True).start()
"""
    )
    peer = ros2_nodes.start(
        """
from geometry_msgs.msg import Twist
node.create_subscription(Twist, "/cmd_vel", lambda m: say(m.linear.x), 10)
"""
    )
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(tmp_path), os.environ.get("PYTHONPATH", "")])))
    said = []
    with RclpyNode(say=said.append) as node:
        wheels = node.publish(WHEELS)
        until(lambda: wheels.put(encode(Twist())) and peer.all(), "the wheels")
        (tmp_path / "now").touch()
        until(lambda: not wheels.put(encode(Twist())), "the loss to be seen")
        until(lambda: len(said) == 2, "the node to be there again")
        peer.all()
        until(lambda: wheels.put(encode(Twist())) and peer.all(), "the wheels again")
    assert said == [
        "the program that is our ROS 2 node ended because ROS 2 was shut down in it; it is started again",
        "our ROS 2 node is there again",
    ]


def test_a_publisher_that_overruns_us_is_counted_and_harms_no_other_topic(ros2_nodes):
    """Messages come quicker than they are taken: the newest win, the loss is counted, the wheels go on."""
    peer = ros2_nodes.start(
        """
from geometry_msgs.msg import Twist
from std_msgs.msg import UInt8MultiArray
node.create_subscription(Twist, "/cmd_vel", lambda m: say(m.linear.x), 10)
flood = node.create_publisher(UInt8MultiArray, "/flood", qos(reliable=False, depth=1))
message = UInt8MultiArray(data=bytes(100_000))
def work():
    sys.stdin.readline()
    while True:
        flood.publish(message)
threading.Thread(target=work, daemon=True).start()
"""
    )
    kind = "std_msgs/msg/UInt8MultiArray"
    go, taken = [], []

    def take(payload):
        taken.append(len(payload))
        until(lambda: go, "the test to go on")

    with RclpyNode() as node:
        wheels = node.publish(WHEELS)
        flood = node.subscribe(Endpoint(Kind.SUBSCRIPTION, "/flood", kind, "", Qos(reliable=False, depth=1)), take)
        until(lambda: wheels.put(encode(Twist())) and peer.all(), "the wheels")
        peer.tell("flood")
        until(lambda: taken, "the flood")
        peer.all()
        until(lambda: wheels.put(encode(Twist())) and peer.all(), "the wheels, while the flood is not taken")
        go.append(True)
        until(lambda: flood.dropped, "the loss to be counted")
        until(lambda: wheels.put(encode(Twist())) and peer.all(), "the wheels, in the flood")
    assert min(taken) > 100_000


def test_a_graph_without_anybody_is_named_until_somebody_comes(ros2_nodes, far_nodes, monkeypatch):
    """Another domain looks like another RMW: as if nobody were there."""
    monkeypatch.setattr(native, "ALONE_S", 1.0)
    said = []
    far_nodes.start("")
    with RclpyNode(say=said.append) as node:
        until(lambda: node.troubles, "a word on that")
        assert said == [
            f"ROS 2 graph (rmw_fastrtps_cpp, domain {ros2_nodes.domain}): no other node is seen: do they have the same "
            "ROS_DOMAIN_ID and RMW_IMPLEMENTATION, and may they be discovered (ROS_AUTOMATIC_DISCOVERY_RANGE, "
            "ROS_STATIC_PEERS)?"
        ]
        ros2_nodes.start("")
        until(lambda: not node.troubles, "the trouble to be over")


def test_a_node_that_is_discovered_late_is_joined_all_the_same(ros2_nodes):
    """Nobody listens at first; whoever comes later is told the newest, and we hear them."""
    got = []
    with RclpyNode() as node:
        kind = "std_msgs/msg/String"
        node.subscribe(Endpoint(Kind.SUBSCRIPTION, "/late", kind, "", Qos(reliable=False, depth=1)), got.append)
        assert node.wait_until_joined(30.0)
        until(lambda: node.middleware, "the node")
        assert not node.nodes
        ros2_nodes.start(
            """
from std_msgs.msg import String
late = node.create_publisher(String, "/late", 10)
node.create_timer(0.05, lambda: late.publish(String(data="here")))
"""
        )
        until(lambda: got, "a message")
        assert decode_text(got[0]) == "here"


def decode_text(payload):
    size = int.from_bytes(payload[4:8], "little")
    return payload[8 : 8 + size - 1].decode()
