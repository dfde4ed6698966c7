"""What a robot's graph publishes, recorded by the service: a type of the user's own, and a topic that comes late."""

from pathlib import Path

import pytest
import yaml
from mcap.reader import make_reader
from ros1_graph import wait_for
from rosbags.highlevel import AnyReader

from skytether.api.manifest import Manifest
from skytether.api.rest import RobotCreate

pytestmark = [pytest.mark.ros1, pytest.mark.slow]

RECORDER = Path(__file__).parents[3] / "services" / "skytether_services" / "recorder" / "service.yaml"
OWN = "int32 secret\nstring word\n"
TALK = f"""
import genpy.dynamic, rospy, sys
Own = genpy.dynamic.generate_dynamic("acme_msgs/Secret", {OWN!r})["acme_msgs/Secret"]
rospy.init_node("acme")
publisher = rospy.Publisher("/secrets", Own, queue_size=100)
print(Own._md5sum, flush=True)
rate, number = rospy.Rate(50), 0
while not rospy.is_shutdown():
    if publisher.get_num_connections():
        publisher.publish(Own(number, "word"))
        number += 1
    rate.sleep()
"""


@pytest.fixture
def recording(graph, orchestrator, tmp_path):
    """A robot that has its late topic and another one recorded; and the folder that they are in."""
    orchestrator.client.put_service("recorder", Manifest.model_validate(yaml.safe_load(RECORDER.read_text())))
    token = tmp_path / "walker.token"
    token.touch(0o600)
    token.write_text(orchestrator.client.create_robot(RobotCreate(name="walker")).token)
    path = tmp_path / "recorded.yaml"
    document = {
        "robot": "walker",
        "orchestrator": orchestrator.url,
        "token_file": "walker.token",
        "service": "recorder",
        "params": {"flush_period": 0.1, "compression": "none"},
        "safety": "none",
        "ros1": {"master": graph.uri, "topics": ["/secrets", "/never"]},
    }
    path.write_text(yaml.safe_dump(document))
    return path, tmp_path / "orchestrator"


def messages(folder):
    """All that is recorded, of all files: schema, channel, message."""
    found = []
    for path in folder.rglob("*.mcap"):
        with path.open("rb") as stream:
            found += make_reader(stream).iter_messages()
    return found


def test_a_late_topic_of_the_user_s_own_type_is_recorded_with_definition_and_hash(graph, orchestrator, recording):
    path, folder = recording
    agent = graph.skytether("robot", "run", str(path))
    wait_for(lambda: "/walker/skytether" in graph.subscribers("/secrets"), "the agent to wait for the topic")
    talker = graph.python(TALK, stdout=-1)
    md5 = talker.stdout.readline().decode().strip()
    wait_for(lambda: any(p.stat().st_size > 10_000 for p in folder.rglob("*.mcap")), "messages in the recording")
    graph.end(talker)
    graph.end(agent)
    orchestrated = orchestrator.client
    wait_for(lambda: all(one.state.final for one in orchestrated.instances()), "the recorder's end")
    found = messages(folder)
    assert {channel.topic for _, channel, _ in found} == {"/secrets"}, "and nothing of what the ends tell each other"
    assert {(schema.name, schema.encoding, schema.data.decode()) for schema, _, _ in found} == {
        ("acme_msgs/Secret", "ros1msg", OWN)
    }
    assert {channel.metadata["topic_type_hash"] for _, channel, _ in found} == {md5}
    assert [message.data[:4] for _, _, message in found][:3] == [n.to_bytes(4, "little") for n in range(3)]


def test_as_a_bag_it_is_what_rosbag_and_rosbags_read(graph, orchestrator, recording):
    path, folder = recording
    document = yaml.safe_load(path.read_text())
    path.write_text(yaml.safe_dump(document | {"params": {"format": "bag", "flush_period": 0.1}}))
    agent = graph.skytether("robot", "run", str(path))
    wait_for(lambda: "/walker/skytether" in graph.subscribers("/secrets"), "the agent to wait for the topic")
    talker = graph.python(TALK, stdout=-1)
    md5 = talker.stdout.readline().decode().strip()
    (bag,) = wait_for(lambda: [p for p in folder.rglob("*.bag") if p.stat().st_size > 12_000], "the bag")
    graph.end(talker)
    graph.end(agent)
    wait_for(lambda: all(one.state.final for one in orchestrator.client.instances()), "the recorder's end")
    with AnyReader([bag]) as reader:
        (connection,) = reader.connections
        assert (connection.topic, connection.digest) == ("/secrets", md5)
        found = [reader.deserialize(data, connection.msgtype) for _, _, data in reader.messages()]
    assert [one.secret for one in found][:10] == list(range(10))
    assert {one.word for one in found} == {"word"}
    info = graph.ask("rosbag", "info", str(bag))
    assert f"acme_msgs/Secret [{md5}]" in info
    assert f"{len(found)} msgs" in info


def test_the_check_says_which_topics_are_missing_now(graph, recording):
    path, _ = recording
    talker = graph.python(TALK, stdout=-1)
    talker.stdout.readline()
    wait_for(lambda: graph.publishers("/secrets"), "the topic")
    check = graph.skytether("robot", "run", str(path), "--check", stdout=-1, stderr=-1)
    found, said = (text.decode() for text in check.communicate(timeout=60))
    assert check.returncode == 0, found + said
    rows = {line.split()[1]: line for line in found.splitlines() if line.startswith(("ok", "..", "!!"))}
    assert rows["/secrets"].startswith("ok")
    assert "acme_msgs/Secret" in rows["/secrets"]
    assert "from /acme" in rows["/secrets"]
    assert rows["/never"].startswith("..")
    assert "nothing is to mend; not there yet, and waited for: /never" in said
    assert "all is there" not in said
