"""An image of one's own with a launch file, on the base for ROS 1 graphs, run by the Docker runtime for a ROS robot."""

import os
import secrets
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import yaml
from ros1_graph import wait_for

from skytether.api.rest import RobotCreate, SiteCreate
from skytether.messages import Header, JointState, TFMessage, Time, decode, encode, hash_of
from skytether.ros.ros1.node import Node
from skytether.ros.ros1.subscription import Listener

ROS1_BASE = Path(__file__).parents[3] / "images" / "ros1-base"
DOCKERFILE = """\
ARG BASE
FROM ${BASE}
USER root
RUN apt-get update -qq && apt-get install -y -qq --no-install-recommends ros-robot-state-publisher >/dev/null
COPY states.launch /launch/
USER 65532:65532
"""
LAUNCH = """
<launch>
  <arg name="robot"/>
  <node pkg="robot_state_publisher" type="robot_state_publisher" name="states">
    <remap from="joint_states" to="/$(arg robot)/joint_states"/>
  </node>
</launch>
"""
URDF = """<robot name="walker"><link name="base_link"/><link name="wheel"/><link name="laser"/>
<joint name="axle" type="continuous"><parent link="base_link"/><child link="wheel"/><axis xyz="0 1 0"/></joint>
<joint name="mount" type="fixed"><parent link="base_link"/><child link="laser"/><origin xyz="1 2 3"/></joint></robot>"""


def build(tag, folder, base):
    command = ["docker", "build", "-q", "-t", tag, "--build-arg", f"BASE={base}", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "DOCKER_BUILDKIT": "0"})
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture(scope="module")
def image(docker_images, tmp_path_factory):
    """The image that a user would build: the base for graphs, one of Debian's nodes, a launch file."""
    prefix = f"skytether-test-{secrets.token_hex(4)}"
    folder = tmp_path_factory.mktemp("states")
    (folder / "Dockerfile").write_text(DOCKERFILE)
    (folder / "states.launch").write_text(LAUNCH)
    try:
        build(f"{prefix}/ros1-base:1", ROS1_BASE, docker_images.name("base"))
        build(f"{prefix}/states:1", folder, f"{prefix}/ros1-base:1")
        yield f"{prefix}/states:1"
    finally:
        tags = [f"{prefix}/states:1", f"{prefix}/ros1-base:1"]
        subprocess.run(["docker", "image", "rm", "-f", *tags], capture_output=True)


def manifest(image):
    more = {"depth": 100, "lifespan_ms": 2000}
    tf = {"type": "tf2_msgs/msg/TFMessage", "direction": "out"}
    topics = [
        {"name": "joint_states", "type": "sensor_msgs/msg/JointState", "direction": "in", **more},
        {"name": "/tf", **tf, **more},
        {"name": "/tf_static", **tf, "reliable": True, "latched": True},
    ]
    spec = {"graph": "ros1", "launch": "/launch/states.launch", "image": image, "topics": topics}
    spec["needs"] = {"cpu": 0.5, "memory_mb": 512}
    return {"apiVersion": "skytether.io/v1", "kind": "Service", "metadata": {"name": "states"}, "spec": spec}


@pytest.mark.docker
@pytest.mark.ros1
@pytest.mark.slow
def test_a_graph_in_a_container_serves_a_robot(graph, orchestrator, docker_site, image, tmp_path):
    client = orchestrator.client
    client.create_site(SiteCreate(name="edge", tier="edge", runtime="docker", options=docker_site.options()))
    client.delete_site("here")  # the one of processes
    client.put_service("states", manifest(image))
    token = tmp_path / "walker.token"
    token.touch(0o600)
    token.write_text(client.create_robot(RobotCreate(name="walker")).token)
    graph.call("setParam", "/robot_description", URDF)
    config = {
        "robot": "walker",
        "orchestrator": orchestrator.url,
        "token_file": "walker.token",
        "service": "states",
        "ros1": {"master": graph.uri, "params": ["/robot_description"]},
        "cloud": {"publish": ["/tf", "/tf_static"]},
        "safety": "none",
    }
    path = tmp_path / "robot.yaml"
    path.write_text(yaml.safe_dump(config))
    heard = {"/tf": [], "/tf_static": []}
    own = Node("own", graph.uri, look_s=0.2)
    own.start()
    for name, kept in heard.items():
        own.subscribe(name, "*", "", Listener(lambda data, _, kept=kept: kept.append(data)))
    kind = "sensor_msgs/msg/JointState"
    joints = own.advertise("/walker/joint_states", kind, hash_of(kind, "ros1"))
    ended = threading.Event()

    def turn():
        while not ended.wait(0.1):
            now = time.time()
            header = Header(Time(int(now), int(now % 1 * 1e9)), "base_link")
            joints.publish(encode(JointState(header, ["axle"], [now % 3]), "ros1"))

    wheel = threading.Thread(target=turn)
    wheel.start()
    process = graph.skytether("robot", "run", str(path), stderr=subprocess.PIPE)
    try:
        for name, kept in heard.items():
            wait_for(lambda kept=kept: kept, f"{name} of the nodes in the container", 90)
        (fixed,) = decode(TFMessage, heard["/tf_static"][-1], "ros1").transforms
        assert (fixed.child_frame_id, fixed.transform.translation.z) == ("laser", 3.0)
        assert decode(TFMessage, heard["/tf"][-1], "ros1").transforms[0].child_frame_id == "wheel"
        (instance,) = client.instances()
        assert (instance.state, instance.placement.site) == ("running", "edge")
        assert len(docker_site.containers()) == 1
    finally:
        sys.stdout.write("".join(client.logs(instance.id) for instance in client.instances()))  # shown if it failed
        process.send_signal(signal.SIGINT)
        sys.stdout.write(process.communicate(timeout=60)[1].decode())
        ended.set()
        wheel.join()
        own.close()
    wait_for(lambda: all(i.state.final for i in client.instances()), "the instance to end")
