"""Unchanged nodes of ROS 2 as a service: an image of one's own on the base for graphs, run by the Docker runtime."""

import os
import secrets
import signal
import subprocess
import sys
from typing import Any

import pytest
import yaml
from ros2_nodes import ros2_nodes, until

from skytether.api.client import Client
from skytether.api.manifest import Manifest
from skytether.api.rest import RobotCreate, SiteCreate
from skytether.lab.embedded import EmbeddedOrchestrator

__all__ = ["ros2_nodes"]
pytestmark = [pytest.mark.slow, pytest.mark.docker, pytest.mark.ros2]

DOCKERFILE = """\
ARG BASE
FROM ${BASE}
COPY guide.py /nodes/
"""
GUIDE = '''\
"""A node as anybody writes one: drives as fast as its parameter says, and repeats what it is told."""

import os
import time

import rclpy
from geometry_msgs.msg import Twist
from std_msgs.msg import String

rclpy.init()
node = rclpy.create_node("guide")
speed = node.declare_parameter("speed", 0.0).value
prefix = node.declare_parameter("words.prefix", "none").value
said = node.create_publisher(String, "said", 10)
wheels = node.create_publisher(Twist, "cmd_vel", 10)


def hear(message):
    if message.data == "hang":
        time.sleep(1000)
    text = f"{prefix} {message.data} {os.getuid()} {sorted(node.get_node_names())}"
    said.publish(String(data=text))


def drive():
    twist = Twist()
    twist.linear.x = speed
    wheels.publish(twist)


node.create_subscription(String, "chat", hear, 10)
node.create_timer(0.05, drive)
try:
    rclpy.spin(node)
except KeyboardInterrupt:
    node.get_logger().info("goodbye")
'''
ROBOT = """
from geometry_msgs.msg import Twist
from std_msgs.msg import String

words = node.create_publisher(String, f"/{NAME}/chat", 10)
word = ["hello"]
node.create_subscription(Twist, f"/{NAME}/cmd_vel", lambda m: say(["speed", m.linear.x]), 10)
node.create_subscription(String, "/guide/said", lambda m: say(["said", m.data]), 10)
node.create_timer(0.1, lambda: words.publish(String(data=word[0])))
def work():
    for line in sys.stdin:
        word[0] = line.strip()
threading.Thread(target=work, daemon=True).start()
"""


@pytest.fixture(scope="module")
def image(docker_images, tmp_path_factory):
    """The image that a user would build: the base for graphs, and a node."""
    tag = f"skytether-test-{secrets.token_hex(4)}/guide:1"
    folder = tmp_path_factory.mktemp("guide")
    (folder / "Dockerfile").write_text(DOCKERFILE)
    (folder / "guide.py").write_text(GUIDE)
    with docker_images.another("ros2-base") as base:
        try:
            command = ["docker", "build", "-q", "-t", tag, "--build-arg", f"BASE={base}", str(folder)]
            subprocess.run(command, check=True, capture_output=True, env={**os.environ, "DOCKER_BUILDKIT": "0"})
            yield tag
        finally:
            subprocess.run(["docker", "image", "rm", "-f", tag], capture_output=True)


def manifest(image, name="guide", **more):
    text = {"type": "std_msgs/msg/String", "depth": 100, "lifespan_ms": 2000}
    topics: list[dict[str, Any]] = [
        {"name": "chat", "direction": "in", **text},
        {"name": "said", "direction": "out", **text},
        {"name": "cmd_vel", "type": "geometry_msgs/msg/Twist", "direction": "out", "priority": 127, "period_ms": 50},
    ]
    words = {"type": "object", "properties": {"prefix": {"type": "string"}}}
    spec = {
        "graph": "ros2",
        "launch": "/nodes/guide.py",
        "image": image,
        "topics": topics,
        "remap": {topic["name"]: "/" + topic["name"] for topic in topics},
        "params": {"properties": {"speed": {"type": "number"}, "words": words}},
        "needs": {"cpu": 0.5, "memory_mb": 512},
        **more,
    }
    document = {"apiVersion": "skytether.io/v1", "kind": "Service", "metadata": {"name": name}, "spec": spec}
    return Manifest.model_validate(document)


@pytest.fixture
def client(docker_site, tmp_path):
    """Of an orchestrator with a Docker site."""
    (tmp_path / "orchestrator").mkdir()
    with (
        EmbeddedOrchestrator(tmp_path / "orchestrator") as orchestrator,
        Client(orchestrator.url, orchestrator.operator_token) as client,
    ):
        client.create_site(SiteCreate(name="edge", tier="edge", runtime="docker", options=docker_site.options()))
        client.delete_site("local")
        client.url = orchestrator.url
        yield client


class Walker:
    """A robot: a node with wheels, and its agent."""

    def __init__(self, name, client, nodes, folder, params):
        token = folder / f"{name}.token"
        token.touch(0o600)
        token.write_text(client.create_robot(RobotCreate(name=name)).token)
        document = {
            "robot": name,
            "orchestrator": client.url,
            "token_file": token.name,
            "service": "guide",
            "params": params,
            "status_port": None,
            "limits": {"max_gap_s": 1.0},
            "safety": "none",
            "ros2": {"remap": {"said": "/guide/said"}},
        }
        path = folder / f"{name}.yaml"
        path.write_text(yaml.safe_dump(document))
        self.node = nodes.start(ROBOT, name)
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        command = [sys.executable, "-m", "skytether.cli", "robot", "run", str(path)]
        self.agent = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)

    def hears(self, kind, what):
        """Whether the node heard such a thing since the last look."""
        return any(told[0] == kind and what(told[1]) for told in self.node.all())

    def drives(self, speed):
        return self.hears("speed", lambda told: abs(told - speed) < 1e-9)

    def stands(self):
        """Whether it is told nothing else for a while."""
        told = [self.node.next() for _ in range(20)]
        return all(what == 0.0 for kind, what in told if kind == "speed")

    def stop(self):
        self.agent.send_signal(signal.SIGINT)
        return self.agent.communicate(timeout=60)[1]


def walker_of(client):
    (instance,) = [one for one in client.instances() if one.robot == "walker"]
    return instance


def test_unchanged_nodes_in_containers_drive_robots_hang_crash_and_end(
    client, docker_site, image, ros2_nodes, tmp_path
):
    client.put_service("guide", manifest(image))
    walker = Walker("walker", client, ros2_nodes, tmp_path, {"speed": 0.25, "words": {"prefix": "1"}})
    other = Walker(
        "other", client, ros2_nodes, tmp_path, {"speed": 0}
    )  # a whole number, for a parameter with a fraction
    try:
        until(lambda: walker.drives(0.25), "the node in the container to drive", 120)
        alone = "65532 ['guide', 'skytether']"
        until(lambda: walker.hears("said", lambda text: text == f"1 hello {alone}"), "what it repeats", 60)
        until(lambda: other.hears("said", lambda text: text == f"none hello {alone}"), "the other's", 60)
        until(lambda: walker.hears("said", lambda text: text == f"1 hello {alone}"), "beside the other, and alone")
        assert len(docker_site.containers()) == 2
        instance = walker_of(client)

        walker.node.tell("hang")
        until(walker.stands, "a robot that nobody drives to stand")
        assert walker_of(client).state == "running"
        walker.node.tell("again")
        (container,) = docker_site.labelled("skytether.io/instance", f"label=skytether.io/instance={instance.id}")
        docker_site.docker("exec", container, "/usr/bin/python3", "-c", END_GUIDE)
        until(lambda: walker_of(client).restarts == 1, "the instance to be started again")
        until(lambda: walker.drives(0.25), "the node to drive again", 60)
        assert "guide.py ended with status -9; see the lines above" in client.logs(instance.id)
    finally:
        logs = "".join(client.logs(one.id) for one in client.instances())
        said = walker.stop() + other.stop()
        sys.stdout.write(logs + said)  # shown if it failed
    until(lambda: all(one.state.final for one in client.instances()), "the instances to end")
    assert {one.state for one in client.instances()} == {"stopped"}
    until(lambda: "goodbye" in "".join(client.logs(one.id) for one in client.instances()), "the node to end in order")
    logs = "".join(client.logs(one.id) for one in client.instances())
    assert "Traceback" not in logs + said


END_GUIDE = """
import os, pathlib
for path in pathlib.Path("/proc").glob("[0-9]*/cmdline"):
    if b"/nodes/guide.py" in path.read_bytes():
        os.kill(int(path.parent.name), 9)
"""
