"""How the agent stands in a ROS 1 graph, beside others and for ROS's own tools: names, log, diagnostics, its end."""

import signal
import subprocess
from pathlib import Path

import pytest
import yaml
from ros1_graph import wait_for

from skytether.messages import decode_plain
from skytether.ros.ros1.node import Node
from skytether.ros.ros1.subscription import Listener

PACKAGE = Path(__file__).parents[3] / "ros1" / "skytether"
pytestmark = [pytest.mark.ros1, pytest.mark.slow]

ENDED = (130, -signal.SIGINT)
"""Status of a command that was told to end: its own, or the interpreter's."""
AWAY = {
    "orchestrator": "http://127.0.0.1:9",
    "token_file": "robot.token",
    "service": "wall-stop",
    "safety": "none",
}
"""A robot whose orchestrator is away: its own controller stops it."""


@pytest.fixture
def robot_yaml(tmp_path, graph):
    """Writes a robot's file."""

    def write(robot, **more):
        token = tmp_path / "robot.token"
        token.touch(0o600)
        token.write_text("secret")
        path = tmp_path / f"{robot}.yaml"
        path.write_text(yaml.safe_dump({"robot": robot, **AWAY, "ros1": {"master": graph.uri}, **more}))
        return str(path)

    return write


def registered(graph, node):
    """What the master knows of a node: publishers, subscribers and services."""
    return sorted(name for rows in graph.call("getSystemState") for name, nodes in rows if node in nodes)


def test_two_robots_in_one_graph_stand_side_by_side(graph, robot_yaml):
    first = graph.skytether("robot", "run", robot_yaml("one"))
    wait_for(lambda: graph.publishers("/one/cmd_vel") == ["/one/skytether"], "the first robot")
    second = graph.skytether("robot", "run", robot_yaml("two"))
    wait_for(lambda: graph.publishers("/two/cmd_vel") == ["/two/skytether"], "the second robot")
    assert "/one/skytether" in graph.ask("rosnode", "ping", "-c", "1", "/one/skytether")
    assert graph.ask("rosnode", "list").split() == ["/one/skytether", "/two/skytether"]
    assert first.poll() is second.poll() is None


def test_who_takes_a_node_s_name_ends_it_and_that_is_what_it_says(graph, robot_yaml):
    agent = graph.skytether("robot", "run", robot_yaml("one"), stderr=subprocess.PIPE)
    wait_for(lambda: graph.publishers("/one/cmd_vel") == ["/one/skytether"], "the agent")
    with Node("/one/skytether", graph.uri, look_s=0.2) as other:
        other.advertise("/one/else", "std_msgs/Bool", "8b94c1b53db61fb6aed406028ad6332a")
        said = agent.stderr.read().decode()
        assert agent.wait(30) == 0
        assert "another node registered as /one/skytether" in said
        assert "rosnode kill" not in said
        assert "was restarted" not in said
        wait_for(lambda: registered(graph, "/one/skytether") == ["/one/else"], "only what the other one has")


def test_what_ros_gives_on_the_command_line_counts(graph, robot_yaml):
    path = robot_yaml("one", cloud={"publish": ["/map"]})
    words = ("__name:=agent", "__ns:=/hall", "cmd_vel:=/base/cmd_vel", "__log:=/tmp/x", "_nonsense:=1")
    agent = graph.skytether("robot", "run", path, *words, stderr=subprocess.PIPE)
    wait_for(lambda: graph.publishers("/base/cmd_vel") == ["/hall/agent"], "the agent under its other name")
    assert graph.end(agent, signal.SIGTERM) in ENDED
    assert "the private parameter /hall/agent/nonsense is none of service, params" in agent.stderr.read().decode()
    wrong = graph.skytether("robot", "run", path, "scan=/front", stderr=subprocess.PIPE)
    assert wrong.wait(30) == 2
    assert "'scan=/front' is no argument of ROS" in wrong.stderr.read().decode()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_what_was_registered_is_unregistered_at_the_end_the_gate_s_nodes_too(graph, robot_yaml, tmp_path, number):
    path = robot_yaml("one", safety={"folder": str(tmp_path / "gate"), "footprint": {"radius": 0.3}, "sensors": {}})
    agent = graph.skytether("robot", "run", path)
    nodes = ("/one/skytether", "/one/skytether_guard", "/one/skytether_gate")
    for node in nodes:
        wait_for(lambda node=node: registered(graph, node), node)
    tools = ["/diagnostics", "/one/skytether/get_loggers", "/one/skytether/set_logger_level", "/rosout"]
    wait_for(lambda: registered(graph, "/one/skytether") == tools, "what ROS's tools look for")
    assert graph.end(agent, number) in ENDED
    assert registered(graph, nodes[0]) == []
    for node in nodes:  # the gate sees to it that the wheels stand before it ends
        wait_for(lambda node=node: not registered(graph, node), node)


def test_roslaunch_gives_name_namespace_remappings_and_private_parameters(graph, robot_yaml, program, tmp_path):
    launch = tmp_path / "robots.launch"
    launch.write_text(
        f"""<launch><group ns="hall">
        <node pkg="skytether" type="robot_run" name="agent" args="{robot_yaml("one")}" output="screen">
          <remap from="cmd_vel" to="/base/cmd_vel"/>
          <param name="service" value="navigation"/>
          <param name="status_port" value="0"/>
          <rosparam param="params">{{max_speed: 0.4}}</rosparam>
        </node></group></launch>"""
    )
    more = {"ROS_PACKAGE_PATH": f"{PACKAGE.parent}:/usr/share", "SKYTETHER": str(program)}
    launched = graph.start("roslaunch", str(launch), env={**graph.environment, **more})
    wait_for(lambda: graph.publishers("/base/cmd_vel") == ["/hall/agent"], "the agent under roslaunch's name")
    assert statuses(graph)["hall/agent: service"]["asked for"] == "navigation"
    graph.end(launched)
    wait_for(lambda: registered(graph, "/hall/agent") == [], "its end")


def test_roslaunch_s_name_without_a_namespace_is_in_the_robot_s(graph, robot_yaml, program):
    more = {
        "ROS_PACKAGE_PATH": f"{PACKAGE.parent}:/usr/share",
        "SKYTETHER": str(program),
        "SKYTETHER_ROBOT": robot_yaml("one", status_port=None),
    }
    graph.call("setParam", "/skytether/service", "navigation")
    launched = graph.start("roslaunch", "skytether", "robot.launch", env={**graph.environment, **more})
    wait_for(lambda: graph.publishers("/one/cmd_vel") == ["/one/skytether"], "the agent")
    assert statuses(graph)["one/skytether: service"]["asked for"] == "navigation"
    graph.end(launched)


def test_the_log_is_on_rosout_and_its_levels_are_asked_and_set_by_ros_s_services(graph, robot_yaml):
    said = []
    with Node("ear", graph.uri, look_s=0.2) as ear:
        ear.subscribe("/rosout", "*", "", Listener(lambda data, _: said.append(data)))
        agent = graph.skytether("robot", "run", robot_yaml("one"))
        wait_for(lambda: any("no orchestrator answers" in one.msg for one in logged(said)), "the trouble on /rosout")
        (trouble,) = [one for one in logged(said) if "no orchestrator answers" in one.msg]
        assert (trouble.name, trouble.level) == ("/one/skytether", 4)
        assert "/one/cmd_vel" in trouble.topics
        assert trouble.header.stamp.sec > 1e9
        loggers = graph.ask("rosservice", "call", "/one/skytether/get_loggers")
        assert 'name: "skytether"' in loggers
        assert 'level: "info"' in loggers
        graph.ask("rosservice", "call", "/one/skytether/set_logger_level", "skytether", "debug")
        assert 'level: "debug"' in graph.ask("rosservice", "call", "/one/skytether/get_loggers")
        graph.end(agent)


def test_how_the_robot_is_stands_in_the_diagnostics(graph, robot_yaml):
    agent = graph.skytether("robot", "run", robot_yaml("one"))
    found = statuses(graph)
    assert (found["one/skytether: control"]["hardware"], found["one/skytether: control"]["level"]) == ("one", 2)
    assert found["one/skytether: control"]["message"].startswith("driven by stop")
    assert found["one/skytether: service"]["level"] == 1
    assert "diagnostic_msgs/DiagnosticArray" in graph.ask("rostopic", "type", "/diagnostics")
    graph.end(agent)


def logged(payloads):
    return [decode_plain("rosgraph_msgs/msg/Log", payload, "ros1") for payload in payloads]


def statuses(graph):
    """What one message of the diagnostics says, by name, the values with the rest."""
    heard = []
    with Node("doctor", graph.uri, look_s=0.2) as ear:
        ear.subscribe("/diagnostics", "*", "", Listener(lambda data, _: heard.append(data)))
        wait_for(lambda: len(heard) > 1, "the diagnostics")
    message = decode_plain("diagnostic_msgs/msg/DiagnosticArray", heard[-1], "ros1")
    assert message.header.stamp.sec > 1e9
    return {
        one.name: {
            "level": one.level,
            "message": one.message,
            "hardware": one.hardware_id,
            **{value.key: value.value for value in one.values},
        }
        for one in message.status
    }
