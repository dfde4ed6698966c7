"""What nodes of real ROS 2 publish, recorded by the service: a topic that comes late, and a type of the user's own."""

import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from mcap.reader import make_reader
from ros2_nodes import ros2_nodes, until
from rosbags.highlevel import AnyReader

from skytether.api.client import Client
from skytether.api.manifest import Manifest
from skytether.api.rest import RobotCreate
from skytether.lab.embedded import EmbeddedOrchestrator
from skytether.messages import hash_of

__all__ = ["ros2_nodes"]
pytestmark = [pytest.mark.slow, pytest.mark.ros2]

RECORDER = Path(__file__).parents[4] / "services" / "skytether_services" / "recorder" / "service.yaml"
STRING = "std_msgs/msg/String"
NESTED = "test_msgs/msg/Nested"
TALK = """
from std_msgs.msg import String
from test_msgs.msg import Nested
words = node.create_publisher(String, "/words", 10)
nested = node.create_publisher(Nested, "/nested", 10)
number = 0
def talk():
    global number
    made = Nested()
    made.basic_types_value.uint16_value = number
    nested.publish(made)
    words.publish(String(data=f"word {number}"))
    number += 1
node.create_timer(0.05, talk)
def tell():
    say(str(node.get_publishers_info_by_topic("/nested")[0].topic_type_hash))
threading.Timer(1.0, tell).start()
"""


@pytest.fixture
def recording(ros2_nodes, tmp_path):
    """The command line with a robot that has its topics recorded, the orchestrator's client, and its folder."""
    folder = tmp_path / "orchestrator"
    folder.mkdir()
    with EmbeddedOrchestrator(folder) as orchestrator, Client(orchestrator.url, orchestrator.operator_token) as client:
        client.put_service("recorder", Manifest.model_validate(yaml.safe_load(RECORDER.read_text())))
        token = tmp_path / "walker.token"
        token.touch(0o600)
        token.write_text(client.create_robot(RobotCreate(name="walker")).token)
        document = {
            "robot": "walker",
            "orchestrator": orchestrator.url,
            "token_file": "walker.token",
            "service": "recorder",
            "params": {"flush_period": 0.1, "compression": "none"},
            "safety": "none",
            "status_port": None,
            "ros2": {
                "namespace": "/",
                "readings": {"force": "geometry_msgs/msg/WrenchStamped"},
                "topics": ["/words", "/nested", "/never"],
            },
        }
        path = tmp_path / "robot.yaml"
        path.write_text(yaml.safe_dump(document))
        yield [sys.executable, "-m", "skytether.cli", "robot", "run", str(path)], client, folder


def test_late_topics_are_recorded_a_type_of_the_user_s_own_too(ros2_nodes, recording):
    command, client, folder = recording
    agent = subprocess.Popen(command)
    try:
        until(lambda: [one for one in client.instances() if one.state == "running"], "the recorder")
        talker = ros2_nodes.start(TALK, "talker")
        rihs = talker.next()
        until(lambda: any(p.stat().st_size > 10_000 for p in folder.rglob("*.mcap")), "messages in the recording")
    finally:
        agent.terminate()
        agent.wait(30)
    until(lambda: all(one.state.final for one in client.instances()), "the recorder's end")
    (path,) = folder.rglob("*.mcap")
    schemas = {}
    with path.open("rb") as stream:
        for schema, channel, _ in make_reader(stream).iter_messages():
            schemas[channel.topic] = schema
            assert channel.metadata["topic_type_hash"] == (
                rihs if channel.topic == "/nested" else hash_of(STRING, "cdr")
            )
    assert {topic: schema.name for topic, schema in schemas.items()} == {"/words": STRING, "/nested": NESTED}
    assert {schema.encoding for schema in schemas.values()} == {"ros2msg"}
    assert "MSG: test_msgs/BasicTypes\nbool bool_value\n" in schemas["/nested"].data.decode()
    with AnyReader([path]) as reader:
        (nested,) = (connection for connection in reader.connections if connection.topic == "/nested")
        found = [reader.deserialize(data, nested.msgtype) for _, _, data in reader.messages([nested])]
    numbers = [one.basic_types_value.uint16_value for one in found]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def test_the_check_has_a_row_for_each_topic_and_reading(ros2_nodes, recording):
    command, *_ = recording
    ros2_nodes.start(TALK, "talker")
    check = subprocess.run([*command, "--check"], capture_output=True, text=True, timeout=60, check=False)
    said = check.stdout + check.stderr
    assert check.returncode == 0, said
    rows = {line.split()[1]: " ".join(line.split()) for line in check.stdout.splitlines() if line[:2] in ("ok", "..")}
    assert rows["/words"].startswith("ok")
    assert "std_msgs/msg/String from /talker" in rows["/words"]
    assert rows["/nested"].startswith("ok")
    assert rows["/never"].startswith("..")
    assert rows["force"].startswith("..")
    assert "nobody publishes it yet; it is followed as it comes" in " ".join(check.stdout.split())
    assert "not there yet, and waited for: /never, /force" in " ".join(said.split())
