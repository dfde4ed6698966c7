"""Our node of ROS 2 beside real ones: real rclpy, real DDS, in processes of their own."""

import os
import signal
import subprocess
import sys
import time
from unittest.mock import Mock

import pytest
from ros2_nodes import ros2_nodes, until

from skytether.bridge.calls import CallError
from skytether.messages import Twist, Vector3, decode, encode, hash_of
from skytether.ros.ros2 import graph
from skytether.ros.ros2.dialect import Endpoint, Kind, NodeName
from skytether.ros.ros2.native.node import RclpyNode
from skytether.ros.ros2.port import Ros2Port
from skytether.ros.ros2.qos import Qos
from skytether.wire.events import MessageReceived
from skytether.wire.topic import Direction, Role, Topic

__all__ = ["ros2_nodes"]
pytestmark = [pytest.mark.slow, pytest.mark.ros2]

TWIST, STRING = Twist.TYPE, "std_msgs/msg/String"
TRIGGER = "std_srvs/srv/Trigger"
RESENT_S = 5.0
"""DDS has sent again what somebody missed who goes on, a heartbeat of 3 s."""
FAST = Twist(linear=Vector3(x=1.5))


@pytest.fixture
def ours(ros2_nodes):
    """Our node, and what it says."""
    said = []
    node = RclpyNode(NodeName("/bot", "skytether"), say=said.append)
    node.said = said
    with node:
        yield node


def publisher(name, kind=TWIST, qos=None, type_hash=None):
    return Endpoint(
        Kind.PUBLISHER, name, kind, hash_of(kind, "cdr") if type_hash is None else type_hash, qos or Qos(depth=1)
    )


def subscription(name, kind=TWIST, depth=1, type_hash=None):
    type_hash = hash_of(kind, "cdr") if type_hash is None else type_hash
    return Endpoint(Kind.SUBSCRIPTION, name, kind, type_hash, Qos(reliable=False, depth=depth))


def cdr(text):
    data = text.encode() + b"\0"
    return b"\0\1\0\0" + len(data).to_bytes(4, "little") + data


def text(payload):
    """Inverse of `cdr`; DDS fills up to four bytes."""
    size = int.from_bytes(payload[4:8], "little")
    return payload[8 : 8 + size - 1].decode()


def trigger_response(message):
    """``success: true`` and a message."""
    return b"\0\1\0\0\1\0\0\0" + cdr(message)[4:]


def trigger_message(response):
    return text(response[4:])


def test_messages_go_through_as_they_are(ros2_nodes, ours):
    peer = ros2_nodes.start(
        """
from geometry_msgs.msg import Twist
out = node.create_publisher(Twist, "back", 10)
def got(message):
    say(message.linear.x)
    message.linear.x += 1.0
    out.publish(message)
node.create_subscription(Twist, "cmd_vel", got, 10)
""",
        namespace="/bot",
    )
    got = []
    ours.subscribe(subscription("/bot/back"), got.append)
    wheels = ours.publish(publisher("/bot/cmd_vel"))
    until(lambda: ours.endpoints("/bot/cmd_vel", Kind.SUBSCRIPTION) and ours.endpoints("/bot/back"), "the peer")
    until(lambda: wheels.put(encode(FAST)) and got, "an answer")
    assert peer.next() == 1.5
    assert decode(Twist, got[0]).linear.x == 2.5
    (seen,) = ours.endpoints("/bot/back", Kind.PUBLISHER)
    assert (seen.node, seen.type_hash) == ("/bot/peer", hash_of(TWIST, "cdr"))
    assert (ours.nodes, ours.middleware, ours.domain) == (1, "rmw_fastrtps_cpp", str(ros2_nodes.domain))
    assert not ours.troubles


def test_what_is_offered_decides_how_we_listen(ros2_nodes, ours):
    """A latched message comes; a publisher with less is heard, too, and the one before it goes on being heard."""
    latched = """
from std_msgs.msg import String
made = node.create_publisher(String, "/map", qos(latched=True, depth=1))
made.publish(String(data="map"))
"""
    ros2_nodes.start(latched)
    got = []
    ours.subscribe(subscription("/map", STRING, type_hash=""), got.append)
    until(lambda: got, "the latched message")
    assert [text(g) for g in got] == ["map"]
    ros2_nodes.start(
        """
from std_msgs.msg import String
made = node.create_publisher(String, "/map", qos(reliable=False, depth=1))
node.create_timer(0.1, lambda: made.publish(String(data="plain")))
""",
        "plain",
    )
    until(lambda: "plain" in map(text, got), "a best-effort message")
    offers = {e.node: (e.qos.reliable, e.qos.transient_local) for e in ours.endpoints("/map", Kind.PUBLISHER)}
    assert offers == {"/peer": (True, True), "/plain": (False, False)}


def test_latched_messages_reach_who_comes_later(ros2_nodes, ours):
    ours.publish(publisher("/map", STRING, Qos(True, True, 1), "")).put(cdr("old"))
    newest = ours.publish(publisher("/plan", STRING, Qos(True, False, 1), ""))
    peer = ros2_nodes.start(
        """
from std_msgs.msg import String
node.create_subscription(String, "/map", lambda m: say(m.data), qos(latched=True))
node.create_subscription(String, "/plan", lambda m: say(m.data), qos(latched=True))
"""
    )
    assert peer.next() == "old"
    until(lambda: ours.troubles, "a word on what does not fit")
    assert ours.troubles == (
        "/plan: the subscription of /peer gets nothing: transient local is asked for, volatile is offered",
    )
    assert newest.put(cdr("x"))
    assert not peer.all()


def test_services_in_both_directions(ros2_nodes, ours):
    peer = ros2_nodes.start(
        """
from std_srvs.srv import Trigger
def answer(request, response):
    response.success, response.message = True, "theirs"
    return response
node.create_service(Trigger, "/theirs", answer)
"""
    )
    asked = []

    def answer(request):
        asked.append(request)
        if len(asked) == 1:
            raise CallError("the other end is away")
        return trigger_response("ours")

    ours.serve(Endpoint(Kind.SERVER, "/ours", TRIGGER), answer)
    client = ours.client(Endpoint(Kind.CLIENT, "/theirs", TRIGGER))
    until(lambda: ours.lives("/theirs", Kind.SERVER), "the service")

    def theirs():
        try:
            return trigger_message(client.call(b"\0\1\0\0\0", 5.0))
        except CallError:
            return None

    until(lambda: theirs() == "theirs", "an answer")
    caller = ros2_nodes.start(
        """
from std_srvs.srv import Trigger
client = node.create_client(Trigger, "/ours")
def ask():
    client.wait_for_service()
    for _ in range(2):
        client.call_async(Trigger.Request()).add_done_callback(lambda f: say(f.result().message))
        time.sleep(0.2)
threading.Thread(target=ask, daemon=True).start()
""",
        "caller",
    )
    assert caller.next() == "ours"
    assert len(asked) == 2
    assert ours.troubles == ("/ours: a call was not answered: the other end is away",)
    with pytest.raises(CallError, match="/nobody: no node of the ROS 2 graph offers this service"):
        ours.client(Endpoint(Kind.CLIENT, "/nobody", TRIGGER)).call(b"\0\1\0\0\0", 5.0)
    assert peer.process.poll() is None


def test_what_does_not_fit_is_named_and_carried_in_no_direction(ros2_nodes, ours):
    ros2_nodes.start(
        """
from std_msgs.msg import String
from geometry_msgs.msg import Twist
other, same = node.create_publisher(String, "/typed", 10), node.create_publisher(Twist, "/hashed", 10)
node.create_timer(0.05, lambda: (other.publish(String()), same.publish(Twist())))
"""
    )
    got = []
    wrong = "RIHS01_" + "0" * 64
    ours.subscribe(subscription("/typed"), got.append)
    hashed = ours.subscribe(subscription("/hashed", type_hash=wrong), got.append)
    ours.publish(publisher("/unknown", "my_msgs/msg/Thing", type_hash=""))
    until(lambda: len(ours.troubles) == 3 and hashed.dropped, "three sentences")
    right = hash_of(TWIST, "cdr")
    sentences = sorted(ours.troubles)
    assert sentences[0] == (
        f"/hashed: the publisher of /peer has {TWIST} with type hash {right}, this end's is {wrong}; it is not joined"
    )
    assert sentences[1] == f"/typed: the publisher of /peer has type {STRING}, this end's is {TWIST}; it is not joined"
    assert sentences[2].startswith("/unknown: type my_msgs/msg/Thing is not known to ROS 2 here (No module named")
    assert not got


def test_services_of_another_type_hash_are_refused_both_ways_with_both_hashes(ros2_nodes, ours, monkeypatch):
    """DDS tells the hashes of request and response; this end's are made others, for peers have the same ROS 2."""
    wrong = "RIHS01_" + "0" * 64
    request, response = (hash_of(f"{TRIGGER}_{part}", "cdr") for part in ("Request", "Response"))
    monkeypatch.setattr(
        graph, "hash_of", lambda kind, _: wrong if kind == f"{TRIGGER}_Response" else hash_of(kind, "cdr")
    )
    peer = ros2_nodes.start(
        """
from std_srvs.srv import Trigger
node.create_service(Trigger, "/theirs", lambda request, response: say("asked") or response)
client = node.create_client(Trigger, "/ours")
"""
    )
    client = ours.client(Endpoint(Kind.CLIENT, "/theirs", TRIGGER, hash_of(TRIGGER, "cdr")))
    until(lambda: client.refused, "the refusal")
    assert client.refused == (
        f"/theirs: the service of /peer has {TRIGGER}_Response with type hash {response}, this end's is {wrong}; "
        "it is not joined"
    )
    assert ours.troubles == (client.refused,)
    with pytest.raises(CallError, match="it is not joined"):
        client.call(b"\0\1\0\0\0", 5.0)
    monkeypatch.setattr(graph, "hash_of", lambda *_: wrong)
    server = ours.serve(Endpoint(Kind.SERVER, "/ours", TRIGGER, hash_of(TRIGGER, "cdr")), lambda _: b"")
    until(lambda: server.refused, "the other refusal")
    assert server.refused == (
        f"/ours: the client of /peer has {TRIGGER}_Request with type hash {request}, this end's is {wrong}; "
        "it is not joined"
    )
    assert not peer.all()


def test_a_program_that_dies_is_started_again(ros2_nodes, ours):
    peer = ros2_nodes.start(
        """
from geometry_msgs.msg import Twist
node.create_subscription(Twist, "/cmd_vel", lambda m: say(m.linear.x), 10)
out = node.create_publisher(Twist, "/odom", 10)
node.create_timer(0.05, lambda: out.publish(Twist()))
"""
    )
    got = []
    ours.subscribe(subscription("/odom"), got.append)
    wheels = ours.publish(publisher("/cmd_vel"))
    until(lambda: wheels.put(encode(FAST)) and peer.all() and got, "both directions")
    os.kill(ours.pid, signal.SIGKILL)
    until(lambda: not wheels.put(encode(FAST)), "the loss to be seen")
    assert wheels.dropped
    until(lambda: ours.said, "a word on that")
    assert ours.said == ["the program that is our ROS 2 node ended by SIGKILL; it is started again"]
    peer.all()
    got.clear()
    until(lambda: wheels.put(encode(FAST)) and peer.all() and got, "both directions again")
    assert ours.said[1:] == ["our ROS 2 node is there again"]
    assert not ours.troubles


def test_a_program_that_hung_publishes_nothing_that_waited_in_it(ros2_nodes, ours):
    peer = ros2_nodes.start(
        """
from geometry_msgs.msg import Twist
node.create_subscription(Twist, "/bot/cmd_vel", lambda m: say(m.linear.x), 100)
"""
    )
    wheels = ours.publish(publisher("/bot/cmd_vel"), fresh_s=0.1)
    puts = 0

    def put(speed):
        nonlocal puts
        puts += 1
        return wheels.put(encode(Twist(linear=Vector3(x=speed))))

    until(lambda: put(0.5) and peer.all(), "the first velocity")
    os.kill(ours.pid, signal.SIGSTOP)
    until(lambda: not put(2.5), "the program to be stuck")
    assert wheels.stuck
    peer.all()
    os.kill(ours.pid, signal.SIGCONT)
    until(lambda: not wheels.stuck, "the program to go on")
    before = wheels.passed
    assert put(0.0)
    until(lambda: peer.heard.extend(peer.all()) or 0.0 in peer.heard, "a velocity again")
    assert 2.5 not in peer.heard
    until(lambda: wheels.passed == before + 1, "it to be counted")
    assert wheels.passed + wheels.dropped == puts
    os.kill(ours.pid, signal.SIGSTOP)
    assert put(0.0)
    os.kill(ours.pid, signal.SIGKILL)
    until(lambda: wheels.passed + wheels.dropped == puts, "what waited in a program that ended to be counted")
    assert wheels.passed == before + 1


@pytest.mark.parametrize("kept", [False, True])
def test_velocities_that_a_program_missed_while_it_hung_are_not_taken_later(ros2_nodes, ours, kept):
    """A reliable publisher sends again what was not acknowledged, and DDS gives a newcomer what it keeps."""
    peer = ros2_nodes.start(
        f"""
from geometry_msgs.msg import Twist
wheels = node.create_publisher(Twist, "/cmd_vel", qos(latched={kept}))
def work():
    number = 0.0
    for line in sys.stdin:
        for _ in range(int(line)):
            message = Twist()
            message.linear.x = number = number + 1.0
            wheels.publish(message)
            time.sleep(0.02)
        say(number)
threading.Thread(target=work, daemon=True).start()
"""
    )

    def publish(count):
        peer.tell(str(count))
        return peer.next()

    got = []
    cmd_vel = ours.subscribe(subscription("/cmd_vel"), lambda m: got.append(decode(Twist, m, "cdr").linear.x))
    until(lambda: publish(5) and got, "a velocity")
    os.kill(ours.pid, signal.SIGSTOP)
    last = publish(50)
    time.sleep(1.0)
    os.kill(ours.pid, signal.SIGCONT)
    time.sleep(RESENT_S)
    first = last - 50 + 1
    assert not [v for v in got if first <= v <= last]
    until(lambda: publish(5) and got[-1] > last, "velocities again")
    if cmd_vel.dropped:  # DDS does not always tell
        until(lambda: ours.said, "a word on that")
        assert ours.said == ["/cmd_vel: our end, or its program, stood still; what came meanwhile is not taken"]


@pytest.mark.parametrize("more", [{}, {"depth": 10}, {"reliable": True, "lifespan": 0.1}])
def test_a_bridge_s_velocity_that_waited_in_a_program_that_hung_is_not_published(ros2_nodes, ours, more):
    """Its topic's lifespan is over; nobody may say anything after it, and the wheels would drive on."""
    peer = ros2_nodes.start(
        """
from geometry_msgs.msg import Twist
node.create_subscription(Twist, "/cmd_vel", lambda m: say(m.linear.x), 100)
"""
    )
    row = Topic("cmd_vel", TWIST, Direction.OUT, **more)
    made = []

    def publish(*arguments, **options):
        made.append(RclpyNode.publish(ours, *arguments, **options))
        return made[0]

    ours.publish = publish
    port = Ros2Port(ours, [row], Role.ROBOT)
    port.attach(Mock())
    (way,) = made

    def deliver(speed):
        port.deliver(MessageReceived(row.name, encode(Twist(linear=Vector3(x=speed))), 0, 0.0, 0.0, 0.0))

    until(lambda: deliver(0.5) or peer.all(), "the first velocity")
    os.kill(ours.pid, signal.SIGSTOP)
    time.sleep(0.1)  # until it does stand still
    until(lambda: deliver(2.5) or way.stuck, "the program to be stuck")
    peer.all()
    os.kill(ours.pid, signal.SIGCONT)
    until(lambda: not way.stuck, "the program to go on")
    until(lambda: deliver(0.0) or peer.heard.extend(peer.all()) or 0.0 in peer.heard, "a velocity again")
    assert 2.5 not in peer.heard
    port.close()


def test_a_bridge_s_velocity_that_comes_late_is_not_published_and_that_is_told(ours):
    """This end, or the network, stood still: what waited comes at once, and nobody may say anything after it."""
    row = Topic("cmd_vel", TWIST, Direction.OUT)
    port = Ros2Port(ours, [row], Role.ROBOT)
    port.attach(Mock())
    dropped = []

    def deliver(sent_at):
        port.deliver(MessageReceived(row.name, encode(Twist()), 0, sent_at, 0.01, 10.0))

    def passed():
        (way,) = port.topics()
        dropped.append(way.dropped)
        return way.passed

    until(lambda: deliver(10.0) or passed(), "a velocity in time")
    before = dropped[-1]
    for _ in range(20):
        deliver(7.0)
    passed()
    assert dropped[-1] >= before + 20
    told = "cmd_vel: velocities that come 0.1 s (lifespan_ms) later than those before them are not published"
    assert any(text.startswith(told) for text in ours.troubles)
    deliver(9.95)
    assert not any(text.startswith(told) for text in ours.troubles)
    port.close()


def test_there_is_a_node_where_no_log_can_be_written(ros2_nodes, monkeypatch):
    """As below systemd's ProtectHome; ROS 2 has its log files below the home folder."""
    for name in ("ROS_LOG_DIR", "ROS_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", "/proc/no-home")
    with RclpyNode(say=lambda _: None) as node:
        until(lambda: node.wait_until_joined(0.1) or node.troubles, "the node")
        assert not node.troubles


@pytest.mark.parametrize("unread", [False, True])
def test_when_the_agent_is_killed_the_wheels_are_told_to_stand(ros2_nodes, unread):
    """Also where it was killed before it had read all that came."""
    peer = ros2_nodes.start(
        """
from geometry_msgs.msg import Twist
node.create_subscription(Twist, "/cmd_vel", lambda m: say(m.linear.x), 10)
odom = node.create_publisher(Twist, "/odom", 10)
def work():
    while not odom.get_subscription_count():
        time.sleep(0.05)
    say("joined")
    for line in sys.stdin:
        for _ in range(50):
            odom.publish(Twist())
            time.sleep(0.01)
        say("published")
threading.Thread(target=work, daemon=True).start()
"""
    )
    agent = f"""
import time
from skytether.messages import Twist, Vector3, encode, hash_of
from skytether.ros.ros2 import graph
from skytether.ros.ros2.dialect import Endpoint, Kind
from skytether.ros.ros2.native.node import RclpyNode
from skytether.ros.ros2.port import Ros2Port
from skytether.ros.ros2.qos import Qos
from skytether.wire.events import MessageReceived
from skytether.wire.topic import Direction, Role, Topic
with RclpyNode() as node:
    hashed = hash_of("{TWIST}", "cdr")
    node.subscribe(Endpoint(Kind.SUBSCRIPTION, "/odom", "{TWIST}", hashed, Qos(depth=10)), lambda _: None)
    endpoint = Endpoint(Kind.PUBLISHER, "/cmd_vel", "{TWIST}", hashed, Qos(depth=1))
    wheels = node.publish(endpoint, farewell=encode(Twist()))
    while True:
        wheels.put(encode(Twist(linear=Vector3(x=1.5))))
        time.sleep(0.02)
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    heard = []
    with subprocess.Popen([sys.executable, "-c", agent], env=environment) as process:
        until(lambda: heard.extend(peer.all()) or {"joined", 1.5} <= {*heard}, "the agent")
        if unread:
            process.send_signal(signal.SIGSTOP)
            peer.tell("publish")
            until(lambda: heard.extend(peer.all()) or "published" in heard, "messages")
        process.kill()
    until(lambda: heard.extend(peer.all()) or 0.0 in heard, "a standstill")
    assert heard[-1] == 0.0


def test_bursts_and_large_messages_arrive_whole(ros2_nodes, ours):
    """A thousand at once on a reliable topic, and images of 6 MB."""
    ros2_nodes.start(
        """
from std_msgs.msg import String, UInt8MultiArray
burst = node.create_publisher(String, "/burst", qos(depth=1000))
image = node.create_publisher(UInt8MultiArray, "/image", qos(depth=5))
large = UInt8MultiArray(data=bytes(6_000_000))
def send():
    while burst.get_subscription_count() < 1 or image.get_subscription_count() < 1:
        time.sleep(0.05)
    for i in range(1000):
        burst.publish(String(data=str(i)))
    for _ in range(5):
        image.publish(large)
        time.sleep(0.2)
threading.Thread(target=send, daemon=True).start()
"""
    )
    burst, images = [], []
    ours.subscribe(subscription("/burst", STRING, 1000, type_hash=""), burst.append)
    ours.subscribe(subscription("/image", "std_msgs/msg/UInt8MultiArray", 5, type_hash=""), images.append)
    until(lambda: len(burst) >= 1000 and len(images) >= 5, "all of it")
    assert [text(b) for b in burst] == [str(i) for i in range(1000)]
    assert [len(i) // 1_000_000 for i in images] == [6] * 5
    assert not ours.troubles


def test_two_nodes_of_one_name_are_told(ros2_nodes, ours):
    ros2_nodes.start("", "skytether", "/bot")
    until(lambda: ours.troubles, "a word on the name")
    name = "another node of this ROS 2 graph is called /bot/skytether, too: name ours otherwise (ros2.node)"
    assert ours.troubles == (name,)


def test_ros_arguments_reach_the_node(ros2_nodes):
    peer = ros2_nodes.start(
        """
from geometry_msgs.msg import Twist
node.create_subscription(Twist, "/base/cmd_vel", lambda m: say(m.linear.x), 10)
"""
    )
    with RclpyNode(arguments=["-r", "/cmd_vel:=/base/cmd_vel"]) as ours:
        wheels = ours.publish(publisher("/cmd_vel"))
        until(lambda: ours.endpoints("/cmd_vel", Kind.SUBSCRIPTION), "the peer, by the name that we know")
        until(lambda: wheels.put(encode(FAST)) and peer.all(), "a message")


def test_arguments_that_are_none_are_told(ros2_nodes):
    said = []
    with RclpyNode(arguments=["-r", "not a rule"], say=said.append) as ours:
        until(lambda: said, "a word on that")
        assert said[0].startswith("ROS 2 does not let us be a node: ")
        assert "not a rule" in said[0]
        assert not ours.wait_until_joined(0.0)


def test_leaving_is_quick_and_leaves_nothing(ros2_nodes):
    with RclpyNode() as ours:
        until(lambda: ours.middleware, "the node")
        pid, began = ours.pid, time.monotonic()
    assert time.monotonic() - began < 3.0
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
