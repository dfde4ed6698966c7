import json
from math import nan
from pathlib import Path

import pytest
import typer
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore
from typer.testing import CliRunner

from skytether.cli.commands import replay as command
from skytether.robot.replay.replay import ReplayConfig, ReplayResult, TopicResult

app = typer.Typer()
app.command()(command.replay)


@pytest.fixture
def bag(tmp_path) -> Path:
    path = tmp_path / "a.bag"
    with Writer(path) as writer:
        topic = writer.add_connection("/talk", "std_msgs/msg/String", typestore=get_typestore(Stores.ROS1_NOETIC))
        writer.write(topic, 1_000_000_000, b"\x01\0\0\0x")
    return path


@pytest.fixture
def token(tmp_path) -> Path:
    path = tmp_path / "robot.token"
    path.write_text("sesame\n")
    return path


def run(*arguments: object):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def refused(result) -> str:
    """The one sentence of a command that failed and printed nothing for programs."""
    assert result.exit_code in (1, 2)
    assert result.stdout == ""
    assert "Traceback" not in result.stderr
    return " ".join(result.stderr.split())


def test_a_recording_that_is_missing_or_none_is_told_before_anything_is_started(tmp_path):
    assert "there is no recording" in refused(run(tmp_path / "none.bag"))
    (tmp_path / "no.bag").write_bytes(b"\xff\x83")
    assert "no.bag is no recording that can be read" in refused(run(tmp_path / "no.bag"))


def test_an_unknown_topic_is_told_with_those_that_there_are(bag, token):
    sentence = refused(run(bag, "--topic", "/tale", "--url", "http://127.0.0.1:9", "--token-file", token))
    assert sentence.endswith("a.bag has no topic /tale; it has /talk")


def test_an_orchestrator_that_does_not_answer_is_told(bag, token):
    sentence = refused(run(bag, "--url", "http://127.0.0.1:9", "--token-file", token))
    assert sentence.count("no orchestrator answers at http://127.0.0.1:9") == 1


def test_a_token_file_that_is_missing_is_told(bag, tmp_path):
    missing = tmp_path / "none.token"
    assert "no token file" in refused(run(bag, "--url", "http://127.0.0.1:9", "--token-file", missing))


def test_a_bad_name_is_told(bag, token):
    sentence = refused(run(bag, "--robot", "My Robot", "--url", "http://127.0.0.1:9", "--token-file", token))
    assert "robot 'My Robot'" in sentence


@pytest.fixture
def streamed(monkeypatch):
    """The command with a replay that delivered as many of two messages as the test says."""

    def prepare(delivered: int) -> None:
        topics = (TopicResult("/talk", "std_msgs/msg/String", 2, 0, 0, 2, delivered, 2 - delivered, 0.00123456, nan),)
        monkeypatch.setattr(command, "_stream", lambda config, client: ReplayResult("i1", 1.23456, topics))

    return prepare


def test_what_arrived_is_printed_as_one_json_object(bag, token, streamed):
    streamed(2)
    result = run(bag, "--json", "--url", "http://127.0.0.1:9", "--token-file", token)
    assert result.exit_code == 0
    assert json.loads(result.stdout) == {
        "bag": str(bag),
        "service": "recorder",
        "robot": "replay",
        "instance": "i1",
        "speed": 1.0,
        "time_s": 1.235,
        "complete": True,
        "topics": {
            "/talk": {
                "type": "std_msgs/msg/String",
                "messages": 2,
                "refused": 0,
                "dropped": 0,
                "sent": 2,
                "delivered": 2,
                "lost": 0,
                "delay_p50_ms": 1.235,
                "delay_p99_ms": None,
            }
        },
        "files": [],
    }


def test_what_did_not_arrive_fails_and_is_shown_in_the_table(bag, token, streamed):
    streamed(1)
    result = run(bag, "--url", "http://127.0.0.1:9", "--token-file", token)
    assert result.exit_code == 1
    assert "/talk" in result.stdout
    assert "data/replay/recorder/i1" in result.stdout
    assert "not every message arrived" in result.stderr


def test_recordings_are_never_overwritten(tmp_path):
    assert command.free_name(tmp_path / "a.mcap") == tmp_path / "a.mcap"
    (tmp_path / "a.mcap").touch()
    (tmp_path / "a-2.mcap").touch()
    assert command.free_name(tmp_path / "a.mcap") == tmp_path / "a-3.mcap"


def test_the_speed_must_be_positive(bag):
    assert run(bag, "--speed", 0).exit_code == 2
    assert ReplayConfig(bag, "r").speed == 1.0


def test_remappings_are_read_and_mistakes_in_them_told(bag, token):
    to = ("--url", "http://127.0.0.1:9", "--token-file", token)
    assert command.remappings(["/scan:=scan", "/a:=/b"]) == {"/scan": "scan", "/a": "/b"}
    assert "must be OLD:=NEW" in refused(run(bag, "--remap", "/talk=talk", *to))
    assert "/talk is renamed twice" in refused(run(bag, "--remap", "/talk:=a", "--remap", "/talk:=b", *to))
    assert "has no topic /tale" in refused(run(bag, "--remap", "/tale:=talk", *to))


def test_two_topics_cannot_be_sent_as_one(tmp_path, token):
    path = tmp_path / "two.bag"
    with Writer(path) as writer:
        for name in ("/a", "/b"):
            writer.add_connection(name, "std_msgs/msg/String", typestore=get_typestore(Stores.ROS1_NOETIC))
    told = refused(run(path, "--remap", "/a:=/b", "--url", "http://127.0.0.1:9", "--token-file", token))
    assert "would be sent as /b" in told
