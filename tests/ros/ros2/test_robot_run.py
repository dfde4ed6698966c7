"""``skytether robot run`` on a robot that is a ROS 2 graph: a real router, orchestrator and service; played nodes."""

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import yaml

from skytether.api.client import Client
from skytether.api.manifest import Manifest
from skytether.api.rest import RobotCreate, SiteCreate
from skytether.lab.embedded import EmbeddedOrchestrator
from skytether.messages import Header, LaserScan, Time, Twist, TwistStamped, decode, encode, type_hash

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[3]
SCAN, DDS_SCAN = LaserScan.TYPE, "sensor_msgs::msg::dds_::LaserScan_"
DDS_STAMPED = "geometry_msgs::msg::dds_::TwistStamped_"
FREE = LaserScan(Header(Time(1)), angle_min=-1.0, angle_increment=0.01, range_max=10.0, ranges=[3.0] * 200)


@pytest.fixture
def orchestrator(tmp_path):
    """An orchestrator that runs services from this checkout."""
    (tmp_path / "orchestrator").mkdir()
    with (
        EmbeddedOrchestrator(tmp_path / "orchestrator") as orchestrator,
        Client(orchestrator.url, orchestrator.operator_token) as client,
    ):
        options = {"python_path": [str(ROOT / folder) for folder in ("platform", "services", "docs/examples")]}
        client.create_site(SiteCreate(name="here", tier="edge", runtime="process", options=options))
        client.delete_site("local")
        orchestrator.client = client
        yield orchestrator


@pytest.fixture
def config(stage, orchestrator, tmp_path):
    """A robot.yaml, and the robot registered."""
    manifest = yaml.safe_load((ROOT / "docs" / "examples" / "wall_stop" / "service.yaml").read_text())
    manifest["spec"]["needs"] = {"cpu": 0.1}  # how well a busy machine keeps time is not what is asked here
    orchestrator.client.put_service("wall-stop", Manifest.model_validate(manifest))
    token = tmp_path / "walker.token"
    token.touch(0o600)
    token.write_text(orchestrator.client.create_robot(RobotCreate(name="walker")).token)
    path = tmp_path / "robot.yaml"
    ros2 = {
        "dialect": "rmw_zenoh",
        "router": stage.router.address,
        "domain": stage.domain,
        "namespace": "/",
        "cmd_vel_type": TwistStamped.TYPE,
    }
    document = {
        "robot": "walker",
        "orchestrator": orchestrator.url,
        "token_file": "walker.token",
        "service": "wall-stop",
        "limits": {"max_gap_s": 1.0},
        "safety": "none",
        "ros2": ros2,
    }
    path.write_text(yaml.safe_dump(document))
    return path


@pytest.fixture
def skytether():
    """Starts the command line."""
    started = []

    def start(*arguments):
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        command = [sys.executable, "-m", "skytether.cli", *arguments]
        process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


class Laser:
    """A laser at 20 Hz."""

    def __init__(self, publish):
        self.scan = FREE
        self._publish = publish
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._ended.set()
        self._thread.join()

    def _run(self):
        while not self._ended.wait(0.05):
            self._publish(encode(self.scan, "cdr"))


def test_a_service_drives_a_robot_of_ros_2(stage, config, skytether):
    base = stage.rmw("base")
    wheels = base.subscribe("/cmd_vel", DDS_STAMPED, type_hash(TwistStamped, "cdr"))

    def speed():
        return decode(TwistStamped, wheels.payloads[-1]).twist.linear.x if wheels.samples else None

    with Laser(base.publisher("/scan", DDS_SCAN, type_hash(LaserScan, "cdr"))) as laser:
        process = skytether("robot", "run", str(config))
        stage.until(lambda: speed() is not None and abs(speed() - 0.2) < 1e-9, "the service does not drive")
        told = decode(TwistStamped, wheels.payloads[-1]).header
        assert told.frame_id == "base_link"
        assert told.stamp.sec > 1_700_000_000
        laser.scan = LaserScan(angle_min=-1.0, angle_increment=0.01, range_max=10.0)
        stage.until(lambda: speed() == 0.0, "no standstill before a laser without ranges")
        laser.scan = FREE
        stage.until(lambda: speed() > 0.1, "the service does not drive again")
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=30)
    stage.until(lambda: speed() == 0.0, "the last word was no standstill")
    stage.until(lambda: not base.sees("MP", "/cmd_vel"), "still on the graph")
    assert "driving: cloud" in said
    assert "Traceback" not in said


def test_the_check_looks_topic_by_topic(stage, config, skytether):
    base = stage.rmw("base")
    base.subscribe("/cmd_vel", "geometry_msgs::msg::dds_::Twist_", type_hash(Twist, "cdr"))
    base.publisher("/scan", DDS_SCAN, "RIHS01_" + "0" * 64)
    process = skytether("robot", "run", str(config), "--check")
    found, said = process.communicate(timeout=60)
    assert process.returncode == 1, found + said
    assert "2 to mend" in said
    assert found.count("!!") == 2
    examined = skytether("doctor", str(config), "--json")
    findings = [f for f in json.loads(examined.communicate(timeout=60)[0]) if f["check"] in ("types", "ros graph")]
    assert {f["state"] for f in findings} == {"trouble"}
    assert any("RIHS01_" + "0" * 64 in f["says"] for f in findings)
    plain = "".join(found.split())
    assert "RIHS01_" + "0" * 64 in plain
    assert type_hash(LaserScan, "cdr") in plain
    assert "setros2.cmd_vel_type" in plain
    base.close()
    good = stage.rmw("base")
    good.subscribe("/cmd_vel", DDS_STAMPED, type_hash(TwistStamped, "cdr"))
    good.publisher("/scan", DDS_SCAN, type_hash(LaserScan, "cdr"), depth=1)
    process = skytether("robot", "run", str(config), "--check")
    found, said = process.communicate(timeout=60)
    assert process.returncode == 0, found + said
    assert "all is there" in said
    plain = " ".join(found.split())
    assert "from /base" in plain
    assert "transient local" in plain


def test_without_a_router_the_check_says_so_and_a_run_waits(stage, config, skytether, own_stage):
    document = yaml.safe_load(config.read_text())
    document["ros2"] |= {"router": own_stage.router.address, "domain": 0}
    config.write_text(yaml.safe_dump(document))
    process = skytether("robot", "run", str(config), "--check")
    found, said = process.communicate(timeout=60)
    assert process.returncode == 1, found + said
    assert "does not answer" in " ".join(found.split())
    process = skytether("robot", "run", str(config))
    own_stage.router.start()
    base = own_stage.rmw("base")
    wheels = base.subscribe("/cmd_vel", DDS_STAMPED, type_hash(TwistStamped, "cdr"))
    own_stage.until(lambda: wheels.samples, "the wheels were told nothing once the router was there")
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=30)
    assert "Traceback" not in said
