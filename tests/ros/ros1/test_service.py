"""Unchanged nodes of ROS 1 as a service: roscore and launch file, started by the orchestrator, joined to a robot."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
import yaml
from ros1_graph import wait_for
from rosbags.typesys import Stores, get_typestore

from skytether.api.grant import Grant
from skytether.api.manifest import Manifest
from skytether.api.rest import RobotCreate
from skytether.messages import (
    Header,
    JointState,
    String,
    TFMessage,
    Time,
    decode,
    encode,
    hash_of,
)
from skytether.ros.ros1.node import Node
from skytether.ros.ros1.subscription import Listener
from skytether.service.ros1 import launch_arguments
from skytether.service.ros_graph import ros_environment

LAUNCH = """
<launch>
  <arg name="robot"/>
  <arg name="service"/>
  <arg name="rate" default="1"/>
  <node pkg="topic_tools" type="relay" name="relay" args="/$(arg robot)/chat /$(arg service)/echo"/>
  <node pkg="topic_tools" type="throttle" name="throttle"
        args="messages /$(arg robot)/chat $(arg rate) /$(arg service)/slow"/>
  <node pkg="robot_state_publisher" type="robot_state_publisher" name="states">
    <remap from="joint_states" to="/$(arg robot)/joint_states"/>
  </node>
  <node pkg="image_proc" type="image_proc" name="image_proc" ns="/$(arg robot)/camera">
    <remap from="image_rect" to="/$(arg service)/image_rect"/>
  </node>
</launch>
"""
URDF = """<robot name="walker"><link name="base_link"/><link name="wheel"/><link name="laser"/>
<joint name="axle" type="continuous"><parent link="base_link"/><child link="wheel"/><axis xyz="0 1 0"/></joint>
<joint name="mount" type="fixed"><parent link="base_link"/><child link="laser"/><origin xyz="1 2 3"/></joint></robot>"""
STRING = "std_msgs/msg/String"


def row(name, kind, direction, **more):
    return {"name": name, "type": kind, "direction": direction, "depth": 100, "lifespan_ms": 2000, **more}


def manifest(launch):
    image = "sensor_msgs/msg/Image"
    topics = [
        row("chat", STRING, "in"),
        row("echo", STRING, "out"),
        row("slow", STRING, "out"),
        row("joint_states", "sensor_msgs/msg/JointState", "in"),
        row("/tf", "tf2_msgs/msg/TFMessage", "out"),
        row("/tf_static", "tf2_msgs/msg/TFMessage", "out", reliable=True, latched=True),
        row("camera/image_raw", image, "in", compression="zstd"),
        row("camera/camera_info", "sensor_msgs/msg/CameraInfo", "in"),
        row("image_rect", image, "out", compression="zstd"),
    ]
    params = {"properties": {"rate": {"type": "number"}}}
    return Manifest.model_validate(
        {
            "apiVersion": "skytether.io/v1",
            "kind": "Service",
            "metadata": {"name": "ros-tools"},
            "spec": {"graph": "ros1", "launch": str(launch), "topics": topics, "params": params},
        }
    )


@pytest.fixture
def launch(tmp_path):
    path = tmp_path / "packages" / "tools.launch"
    path.parent.mkdir(exist_ok=True)
    path.write_text(LAUNCH)
    return path


class Robot:
    """The robot's own nodes: what the service gets is sent ten times a second, what it gives is kept."""

    def __init__(self, graph):
        self.heard = {name: [] for name in ("echo", "slow", "image_rect", "/tf", "/tf_static")}
        self.node = Node("own", graph.uri, look_s=0.2)
        self.node.start()
        for name, kept in self.heard.items():
            full = name if name.startswith("/") else f"/ros_tools/{name}"
            self.node.subscribe(full, "*", "", Listener(lambda data, _, kept=kept: kept.append(data)))
        self.chat = self._advertise("chat", "std_msgs/msg/String")
        self.joints = self._advertise("joint_states", "sensor_msgs/msg/JointState")
        self.image = self._advertise("camera/image_raw", "sensor_msgs/msg/Image")
        self.info = self._advertise("camera/camera_info", "sensor_msgs/msg/CameraInfo")
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _advertise(self, name, kind):
        return self.node.advertise(f"/walker/{name}", kind, hash_of(kind, "ros1"))

    def _run(self):
        count = 0
        while not self._ended.wait(0.1):
            count += 1
            now = time.time()
            self.chat.publish(encode(String(str(count)), "ros1"))
            header = Header(Time(int(now), int(now % 1 * 1e9)), "camera")
            self.joints.publish(encode(JointState(header, ["axle"], [0.1 * count]), "ros1"))
            for publication, data in zip((self.image, self.info), picture(int(now), count), strict=True):
                publication.publish(data)

    def close(self):
        self._ended.set()
        self._thread.join()
        self.node.close()


def picture(seconds, nanoseconds):
    """A grey image of 32 x 24 and the calibration of a perfect camera."""
    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    header = types["std_msgs/msg/Header"](0, types["builtin_interfaces/msg/Time"](seconds, nanoseconds), "camera")
    image = types["sensor_msgs/msg/Image"](header, 24, 32, "mono8", 0, 32, np.arange(768, dtype=np.uint8))
    zeros = np.zeros(5)
    k = np.array([30.0, 0, 16, 0, 30, 12, 0, 0, 1])
    p = np.array([30.0, 0, 16, 0, 0, 30, 12, 0, 0, 0, 1, 0])
    roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    info = types["sensor_msgs/msg/CameraInfo"](
        header, 24, 32, "plumb_bob", zeros, k, np.eye(3).reshape(-1), p, 0, 0, roi
    )
    return [
        bytes(store.serialize_ros1(image, "sensor_msgs/msg/Image")),
        bytes(store.serialize_ros1(info, "sensor_msgs/msg/CameraInfo")),
    ]


@pytest.mark.ros1
@pytest.mark.slow
def test_topic_tools_image_proc_and_robot_state_publisher_run_as_a_service(graph, orchestrator, launch, tmp_path):
    orchestrator.client.put_service("ros-tools", manifest(launch))
    token = tmp_path / "walker.token"
    token.touch(0o600)
    token.write_text(orchestrator.client.create_robot(RobotCreate(name="walker")).token)
    graph.call("setParam", "/robot_description", URDF)
    config = {
        "robot": "walker",
        "orchestrator": orchestrator.url,
        "token_file": "walker.token",
        "service": "ros-tools",
        "params": {"rate": 2},
        "ros1": {"master": graph.uri, "params": ["/robot_description"]},
        "cloud": {"publish": ["/tf", "/tf_static"]},
        "safety": "none",
    }
    path = tmp_path / "robot.yaml"
    path.write_text(yaml.safe_dump(config))
    robot = Robot(graph)
    process = graph.skytether("robot", "run", str(path), stderr=subprocess.PIPE)
    try:
        for name in robot.heard:
            wait_for(lambda name=name: robot.heard[name], f"{name} of the service's nodes", 60)
        texts = [int(decode(String, data, "ros1").data) for data in robot.heard["echo"]]
        assert texts == sorted(texts)
        (fixed,) = decode(TFMessage, robot.heard["/tf_static"][-1], "ros1").transforms
        assert (fixed.child_frame_id, fixed.transform.translation.z) == ("laser", 3.0)
        assert decode(TFMessage, robot.heard["/tf"][-1], "ros1").transforms[0].child_frame_id == "wheel"
        rectified = get_typestore(Stores.ROS1_NOETIC).deserialize_ros1(
            robot.heard["image_rect"][-1], "sensor_msgs/msg/Image"
        )
        assert (rectified.width, rectified.height, rectified.data.size) == (32, 24, 768)
        before = len(robot.heard["slow"])
        wait_for(lambda: len(robot.heard["slow"]) > before, "what is throttled")
        assert len(robot.heard["slow"]) < len(robot.heard["echo"])
        assert [instance.state for instance in orchestrator.client.instances()] == ["running"]
        home = home_of(launch)
        ours = programs(home)
        assert {"relay", "throttle", "robot_state_publisher", "image_proc"} <= {Path(p).name for p in ours}
    finally:
        log = "".join(orchestrator.client.logs(instance.id) for instance in orchestrator.client.instances())
        process.send_signal(signal.SIGINT)
        said = process.communicate(timeout=60)[1].decode()
        sys.stdout.write(log + said)  # shown if it failed
        robot.close()
    assert "Traceback" not in said
    wait_for(lambda: not programs(home), "all nodes to end with the instance")


def home_of(launch):
    """The folder of the graph that runs our launch file."""
    running = psutil.process_iter(["cmdline", "environ"])
    return next(p.info["environ"]["ROS_HOME"] for p in running if str(launch) in (p.info["cmdline"] or ()))


def programs(home):
    """What runs in the graph with this folder."""
    running = psutil.process_iter(["cmdline", "environ"])
    return [
        p.info["cmdline"][0] for p in running if (p.info["environ"] or {}).get("ROS_HOME") == home and p.info["cmdline"]
    ]


@pytest.fixture
def start_service(ros1, tmp_path):
    """A service as a process, without an orchestrator."""
    made = []

    def start(launch, **more):
        (tmp_path / "tmp").mkdir(exist_ok=True)
        ready = tmp_path / "ready.json"
        grant = Grant(
            instance="i1",
            service="ros-tools",
            robot="walker",
            session_id="00000000000000ab",
            session_key="MDEyMzQ1Njc4OTAxMjM0NTY3ODkwMTIzNDU2Nzg5MDE=",
            topics=manifest(launch).spec.topics,
            launch=str(launch),
            ready_file=str(ready),
            **more,
        )
        (tmp_path / "grant.json").write_text(grant.model_dump_json())
        process = subprocess.Popen(
            [sys.executable, "-m", "skytether.service.ros1"],
            env={
                **os.environ,
                "PYTHONPATH": os.pathsep.join(sys.path),
                "SKYTETHER_GRANT": str(tmp_path / "grant.json"),
                "TMPDIR": str(tmp_path / "tmp"),
            },
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        made.append(process)
        return process, ready

    yield start
    for process in made:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        process.stderr.close()


@pytest.mark.ros1
@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_roscore_and_temporary_files_end_with_the_service_also_if_it_is_killed(start_service, launch, tmp_path, number):
    process, ready = start_service(launch)
    wait_for(ready.exists, "the service")
    assert list((tmp_path / "tmp").iterdir())
    core = [p for p in psutil.process_iter(["environ"]) if in_folder(p, tmp_path)]
    assert core
    os.killpg(process.pid, number)
    assert process.wait(30) == (0 if number == signal.SIGTERM else -signal.SIGKILL)
    wait_for(lambda: not any(p.is_running() for p in core), "roscore to end")
    wait_for(lambda: not list((tmp_path / "tmp").iterdir()), "the folders to be removed")


def in_folder(process, folder):
    return str(folder) in (process.info["environ"] or {}).get("ROS_HOME", "")


@pytest.mark.ros1
@pytest.mark.slow
def test_a_service_without_a_robot_ends_by_itself(start_service, launch, tmp_path):
    process, _ = start_service(launch, idle_exit_s=0.5)
    said = process.stderr.read().decode()
    assert process.wait(30) == 0
    assert "no robot for 0.5 s" in said
    assert not list((tmp_path / "tmp").iterdir())


def grant(launch, **params):
    common = {"instance": "i", "service": "ros-tools", "robot": "walker", "topics": ()}
    return Grant(**common, session_id="0" * 16, session_key="", params=params, launch=str(launch))


def test_roslaunch_is_given_what_the_launch_file_takes(launch):
    arguments = launch_arguments(str(launch), grant(launch, rate=2.5, more=1))
    assert arguments == [str(launch), "robot:=walker", "service:=ros_tools", "rate:=2.5"]
    assert launch_arguments("navigation/move.launch", grant("x")) == ["navigation", "move.launch"]


@pytest.mark.parametrize(
    ("path", "says"),
    [
        ("/nowhere/x.launch", "cannot read the launch file"),
        ("x.launch", "package/file.launch"),
        ("BROKEN", "is no XML"),
    ],
)
def test_a_launch_file_that_cannot_be_is_told_in_a_sentence(tmp_path, path, says):
    from skytether.service.errors import ConfigError

    if path == "BROKEN":
        path = str(tmp_path / "x.launch")
        Path(path).write_text("<launch>")
    with pytest.raises(ConfigError, match=says):
        launch_arguments(path, grant(path))


def test_nodes_get_a_master_of_their_own_and_nothing_of_ours(tmp_path):
    environ = {
        "PATH": f"{Path(sys.executable).parent}:/usr/bin",
        "PYTHONPATH": "/x",
        "SKYTETHER_GRANT": "/secret",
        "ROS_MASTER_URI": "http://other:1",
        "HOME": "/root",
    }
    found = ros_environment(environ, tmp_path, {"ROS_MASTER_URI": "http://127.0.0.1:4711"})
    assert found["PATH"] == "/usr/bin"
    assert found["ROS_MASTER_URI"] == "http://127.0.0.1:4711"
    assert not {"PYTHONPATH", "SKYTETHER_GRANT"} & set(found)
