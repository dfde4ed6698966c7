"""Two real masters, a bridge between their graphs: topics, services, actions and parameters of real nodes."""

import subprocess

import pytest
from ros1_graph import wait_for

from skytether.messages import (
    String,
    TFMessage,
    Transform,
    TransformStamped,
    Vector3,
    decode,
    encode,
    type_hash,
)
from skytether.messages.std import Header
from skytether.ros.ros1.node import Node
from skytether.ros.ros1.subscription import Listener

pytestmark = [pytest.mark.ros1, pytest.mark.slow]

STRING, MD5 = "std_msgs/msg/String", type_hash(String, "ros1")
TF, TF_MD5 = "tf2_msgs/msg/TFMessage", type_hash(TFMessage, "ros1")
CHAT = {"name": "chat", "type": STRING, "direction": "in", "depth": 1000, "lifespan_ms": 10_000}


def string(text):
    return encode(String(text), "ros1")


@pytest.fixture
def other(request):
    """Nodes of others in a graph: publish and hear raw bytes without starting a process for each."""
    made = []

    def make(graph, name="other"):
        node = Node(name, graph.uri, look_s=0.2)
        node.start()
        made.append(node)
        return node

    yield make
    for node in made:
        node.close()


def hear(node, topic, kind="*", md5=""):
    heard = []
    node.subscribe(topic, kind, md5, Listener(lambda data, info: heard.append(data)))
    return heard


def test_topics_are_found_under_the_namespaces_of_their_sources_both_ways(make_pair, other):
    _, robot, service = make_pair(CHAT, {**CHAT, "name": "answer", "direction": "out"})
    talker, listener = other(robot), other(service)
    heard = hear(listener, "/walker/chat", STRING, MD5)
    ours = talker.advertise("/walker/chat", STRING, MD5, queue=1000)
    wait_for(
        lambda: "/skytether" in ours.subscribers and listener.publishers_by_topic()["/walker/chat"][0], "both ends"
    )
    sent = [string(str(n)) for n in range(500)]
    for data in sent:
        ours.publish(data)
    wait_for(lambda: len(heard) == len(sent), "all messages")
    assert heard == sent

    back = hear(talker, "/navigation/answer", STRING, MD5)
    theirs = listener.advertise("/navigation/answer", STRING, MD5)
    wait_for(
        lambda: theirs.subscribers and talker.publishers_by_topic()["/navigation/answer"][0], "both ends of the answer"
    )
    theirs.publish(string("hello"))
    wait_for(lambda: back == [string("hello")], "the answer")


def test_how_topics_stand_is_seen_as_they_come(make_pair, other):
    """As ``skytether robot status`` shows them."""
    pair, robot, _ = make_pair(CHAT, {**CHAT, "name": "answer", "direction": "out"})

    def seen(name):
        return next((topic for topic in pair.robot.topics() if topic.name == name), None)

    wait_for(lambda: seen("answer"), "what was agreed")
    assert (seen("chat").way, seen("chat").there, seen("chat").graph) == ("from", False, "/walker/chat")
    assert (seen("answer").way, seen("answer").there, seen("answer").graph) == ("to", False, "/navigation/answer")
    talker = other(robot, "talker")
    talker.advertise("/walker/chat", STRING, MD5, latched=True)
    hear(talker, "/navigation/answer", STRING, MD5)
    wait_for(lambda: seen("chat").there and seen("answer").there, "both")
    assert (seen("chat").nodes, seen("chat").quality) == (("/talker",), "latched")
    assert seen("answer").nodes == ("/talker",)


def test_remapped_names_and_real_tools_at_both_ends(make_pair):
    _, robot, service = make_pair(
        CHAT, config={"namespace": "/", "remap": {"chat": "/front/chat"}}, remap={"chat": "/chat"}
    )
    echo = service.start("rostopic", "echo", "/chat", stdout=subprocess.PIPE)
    robot.start("rostopic", "pub", "-r", "20", "/front/chat", "std_msgs/String", "data: hello")
    assert echo.stdout.readline() == b'data: "hello"\n'


def test_latched_topics_reach_those_who_come_late_at_the_other_end(make_pair, other):
    latched = {"name": "map", "type": STRING, "direction": "in", "reliable": True, "latched": True}
    _, robot, service = make_pair(latched)
    ours = other(robot).advertise("/walker/map", STRING, MD5, latched=True)
    ours.publish(string("a map"))
    first = hear(other(service, "first"), "/walker/map")
    wait_for(lambda: first == [string("a map")], "the map")
    late = hear(other(service, "late"), "/walker/map")
    wait_for(lambda: late == [string("a map")], "the map, late")


def transform(child):
    return TransformStamped(Header(frame_id="base_link"), child, Transform(Vector3(x=1.0)))


def test_static_transforms_of_several_publishers_arrive_as_one_latched_message(make_pair, other):
    row = {"name": "/tf_static", "type": TF, "direction": "in", "reliable": True, "latched": True}
    _, robot, service = make_pair(row)
    whole = encode(TFMessage([transform("laser"), transform("camera")]), "ros1")
    for name, child in (("a", "laser"), ("b", "camera"), ("c", "laser")):
        publication = other(robot, name).advertise("/tf_static", TF, TF_MD5, latched=True)
        publication.publish(encode(TFMessage([transform(child)]), "ros1"))
        wait_for(lambda publication=publication: publication.subscribers, "the bridge")

    def frames():
        heard = hear(other(service, f"late{len(made)}"), "/tf_static")
        made.append(heard)
        wait_for(lambda: heard, "the static transforms")
        return {t.child_frame_id for t in decode(TFMessage, heard[-1], "ros1").transforms}

    made = []
    wait_for(lambda: frames() == {"laser", "camera"}, "both frames")
    assert sorted(made[-1][-1]) == sorted(whole)


def test_a_type_that_only_the_graph_knows_is_carried_with_its_definition(make_pair, other):
    md5, definition = "0123456789abcdef0123456789abcdef", "int32 secret\n"
    _, robot, service = make_pair({**CHAT, "type": "my_msgs/msg/Own"})
    publication = other(robot).advertise("/walker/chat", "my_msgs/Own", md5, definition)
    listener = other(service)
    heard = hear(listener, "/walker/chat")

    def talk():
        publication.publish(b"\x01\x02\x03\x04")
        return heard

    wait_for(talk, "the message")
    assert heard[0] == b"\x01\x02\x03\x04"
    (info,) = listener.publishers_by_topic()["/walker/chat"][0].values()
    assert (info.type, info.md5, info.definition) == ("my_msgs/Own", md5, definition)


def test_a_topic_of_another_type_is_left_out_with_both_sums_named_and_the_others_go_on(make_pair, other, caplog):
    _, robot, service = make_pair(CHAT, {**CHAT, "name": "more"})
    talker, listener = other(robot), other(service)
    heard, more = hear(listener, "/walker/chat"), hear(listener, "/walker/more")
    wrong = talker.advertise("/walker/chat", "std_msgs/Bool", "8b94c1b53db61fb6aed406028ad6332a", latched=True)
    right = talker.advertise("/walker/more", STRING, MD5, latched=True)
    wrong.publish(b"\x01")
    wait_for(lambda: "topic /walker/chat: /other publishes std_msgs/Bool" in caplog.text, "the complaint")
    wait_for(
        lambda: "/skytether" in right.subscribers and listener.publishers_by_topic()["/walker/more"][0], "both ends"
    )
    right.publish(string("fine"))
    assert "8b94c1b53db61fb6aed406028ad6332a" in caplog.text
    assert MD5 in caplog.text
    wait_for(lambda: more == [string("fine")], "the right one")
    assert heard == []


SERVER = """
import rospy
from std_srvs.srv import SetBool, SetBoolResponse
rospy.init_node("lamp")
def handle(request):
    if not request.data:
        raise rospy.ServiceException("no such thing")
    return SetBoolResponse(True, "shines")
rospy.Service("/navigation/lamp", SetBool, handle)
rospy.spin()
"""
LAMP = {"name": "lamp", "kind": "call", "type": "std_srvs/srv/SetBool", "direction": "in"}


def test_services_are_there_while_the_other_end_has_them_and_the_first_call_s_type_is_checked(make_pair, caplog):
    _, robot, service = make_pair(LAMP)
    server = service.python(SERVER)
    robot.ask("rosservice", "find", "std_srvs/SetBool")
    wait_for(lambda: dict(robot.call("getSystemState")[2]).get("/navigation/lamp"), "the service at the robot")
    call = """
import rospy, sys
from std_srvs.srv import SetBool, Trigger
rospy.init_node("client")
def ask(kind, *request):
    try:
        return rospy.ServiceProxy("/navigation/lamp", kind)(*request).message
    except rospy.ServiceException as error:
        return str(error)
print(ask(Trigger))
print(ask(SetBool, True))
print(ask(SetBool, False))
"""
    refused, answered, failed = robot.ask("/usr/bin/python3", "-c", call).splitlines()
    assert "937c9679a518e3a18d831e57125ea522" in refused
    assert "09fb03525b03e7ea1fd3992bafd87e16" in refused
    assert answered == "shines"
    assert "no such thing" in failed
    service.end(server)
    wait_for(lambda: not dict(robot.call("getSystemState")[2]).get("/navigation/lamp"), "its end at the robot")


ACTION_SERVER = """
import rospy, actionlib
from move_base_msgs.msg import MoveBaseAction, MoveBaseFeedback, MoveBaseResult
rospy.init_node("navigator")
def execute(goal):
    for n in range(1000):
        if server.is_preempt_requested():
            server.set_preempted()
            return
        server.publish_feedback(MoveBaseFeedback(goal.target_pose))
        rospy.sleep(0.02)
        if n >= 25 and goal.target_pose.header.frame_id == "map":
            server.set_succeeded(MoveBaseResult())
            return
server = actionlib.SimpleActionServer("/navigation/move_base", MoveBaseAction, execute, auto_start=False)
server.start()
rospy.spin()
"""
ACTION_CLIENT = """
import rospy, actionlib
from actionlib_msgs.msg import GoalStatus
from move_base_msgs.msg import MoveBaseAction, MoveBaseGoal
rospy.init_node("client")
client = actionlib.SimpleActionClient("/navigation/move_base", MoveBaseAction)
assert client.wait_for_server(rospy.Duration(25))
seen = []
goal = MoveBaseGoal()
goal.target_pose.header.frame_id = "map"
goal.target_pose.pose.orientation.w = 1
client.send_goal(goal, feedback_cb=seen.append)
client.wait_for_result(rospy.Duration(25))
print(client.get_state() == GoalStatus.SUCCEEDED, len(seen) > 0)
seen.clear()
goal.target_pose.header.frame_id = "nowhere"
client.send_goal(goal, feedback_cb=seen.append)
while not seen:
    rospy.sleep(0.02)
client.cancel_goal()
client.wait_for_result(rospy.Duration(25))
print(client.get_state() == GoalStatus.PREEMPTED)
"""


def test_navigation_goals_of_real_action_clients_are_reached_and_cancelled(make_pair):
    action = {"name": "move_base", "kind": "action", "type": "move_base_msgs/action/MoveBase", "direction": "in"}
    _, robot, service = make_pair(action)
    service.python(ACTION_SERVER)
    assert robot.ask("/usr/bin/python3", "-c", ACTION_CLIENT, seconds=90).split() == ["True", "True", "True"]


def test_parameters_are_handed_over_and_what_is_not_set_is_named(make_pair, caplog, make_graph):
    pair, robot, service = make_pair(CHAT, config={"params": ("/robot_description", "/camera", "/nothing")})
    wait_for(lambda: pair.told, "the notes")
    assert pair.told[-1].params == {}
    pair.close()
    robot.call("setParam", "/robot_description", "<robot/>")
    robot.call("setParam", "/camera/rate", 15)
    again = type(pair)(robot, service, [], config={"params": ("/robot_description", "/camera", "/nothing")})
    try:
        wait_for(lambda: again.told and again.told[-1].params, "the parameters")
        assert again.told[-1].params == {"/robot_description": "<robot/>", "/camera": {"rate": 15}}
        assert "parameter /nothing is not set" in caplog.text
    finally:
        again.close()


def test_the_clock_of_a_simulation_is_carried_to_the_service(make_pair, other):
    clock_md5 = "a9c97c1d230cfc112e270351a944ee47"
    pair, robot, service = make_pair(CHAT, config={"use_sim_time": True})
    clock = other(robot).advertise("/clock", "rosgraph_msgs/Clock", clock_md5)
    heard = hear(other(service), "/clock", "rosgraph_msgs/Clock", clock_md5)
    wait_for(lambda: clock.subscribers and pair.told, "the bridge")
    assert pair.told[-1].params == {"/use_sim_time": True}

    def tick():
        clock.publish(b"\x05\x00\x00\x00\x00\x00\x00\x00")
        return heard

    wait_for(tick, "the time")
    assert heard[0] == b"\x05\x00\x00\x00\x00\x00\x00\x00"


def test_without_a_simulation_nobody_publishes_a_clock(make_pair):
    _, robot, service = make_pair(CHAT)
    wait_for(lambda: service.publishers("/walker/chat"), "the bridge's topics")
    assert service.publishers("/clock") == []
    assert robot.subscribers("/clock") == []


def test_a_restarted_master_at_the_robot_loses_nothing_for_good(make_pair, other):
    pair, robot, service = make_pair(CHAT)
    heard = hear(other(service), "/walker/chat")
    robot.kill_master()
    wait_for(lambda: pair.robot_node.master_present is False, "the end of the master to be noticed")
    robot.start_master()
    talker = other(robot).advertise("/walker/chat", STRING, MD5)

    def talk():
        talker.publish(string("again"))
        return heard

    wait_for(talk, "messages after the restart")
