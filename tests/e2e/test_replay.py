"""A real recording goes through orchestrator, bridge and recorder, in processes of their own."""

import json
import os
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
from mcap.reader import make_reader
from rosbags.rosbag1 import Reader

from skytether.lab.embedded import EmbeddedOrchestrator

pytestmark = [pytest.mark.slow, pytest.mark.data]


@pytest.fixture
def bag(data_dir) -> Path:
    return data_dir / "legs" / "stationary_simple.bag"


@pytest.fixture
def replay(tmp_path):
    """Run the command with a folder for temporary files of its own, and see that no process is left in it."""
    temporary = tmp_path / "tmp"
    temporary.mkdir()

    def run(*arguments: object) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "skytether.cli", "replay", *map(str, arguments)],
            env={**os.environ, "TMPDIR": str(temporary)},
            capture_output=True,
            text=True,
            timeout=120,
        )

    yield run
    assert not [process for process in psutil.process_iter(["cmdline", "cwd"]) if str(temporary) in str(process.info)]
    assert list(temporary.iterdir()) == []


def test_1265_real_laser_scans_arrive_byte_for_byte(bag, replay, tmp_path):
    output = tmp_path / "output"
    result = replay(bag, "--service", "recorder", "--speed", 30, "--output", output, "--json")
    assert result.returncode == 0, result.stderr
    document = json.loads(result.stdout)
    counts = document["topics"]["/scan"]
    assert (counts["messages"], counts["sent"], counts["delivered"], counts["lost"]) == (1265, 1265, 1265, 0)
    assert document["complete"]

    with Reader(bag) as reader:
        sent = [bytes(data) for _, _, data in reader.messages()]
    (file,) = map(Path, document["files"])
    assert file.parent == output
    with file.open("rb") as stream:
        recorded = sorted(make_reader(stream).iter_messages(), key=lambda found: found[2].sequence)
    assert [message.data for _, _, message in recorded] == sent
    assert {
        (schema.name, schema.encoding, channel.topic, channel.message_encoding) for schema, channel, _ in recorded
    } == {("sensor_msgs/LaserScan", "ros1msg", "/scan", "ros1")}


def test_what_cannot_be_done_is_told_in_a_sentence_and_leaves_nothing_running(bag, replay, tmp_path):
    unknown = replay(bag, "--service", "rekorder")
    assert (unknown.returncode, unknown.stdout) == (1, "")
    assert "rekorder" in unknown.stderr
    assert "Traceback" not in unknown.stderr

    with EmbeddedOrchestrator(tmp_path) as orchestrator:
        (tmp_path / "token").write_text("not-the-token")
        refused = replay(bag, "--url", orchestrator.url, "--token-file", tmp_path / "token")
    assert (refused.returncode, refused.stdout) == (1, "")
    assert "token" in refused.stderr
    assert "Traceback" not in refused.stderr

    nobody = replay(bag, "--url", orchestrator.url, "--token-file", tmp_path / "token")
    assert nobody.returncode == 1
    assert f"no orchestrator answers at {orchestrator.url}" in " ".join(nobody.stderr.split())


def test_a_topic_is_sent_under_the_name_that_the_service_has_for_it(bag, replay, tmp_path):
    output = tmp_path / "output"
    result = replay(bag, "--speed", 60, "--remap", "/scan:=laser", "--output", output, "--json")
    assert result.returncode == 0, result.stderr
    document = json.loads(result.stdout)
    assert document["topics"]["/scan"]["delivered"] == 1265
    with Path(document["files"][0]).open("rb") as stream:
        assert {channel.topic for _, channel, _ in make_reader(stream).iter_messages()} == {"laser"}
