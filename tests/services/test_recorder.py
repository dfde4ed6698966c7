from __future__ import annotations

import math
import resource
import runpy
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from operator import attrgetter
from pathlib import Path
from typing import Any, cast

import pytest
import yaml
from mcap.reader import make_reader

import skytether_services.recorder
from skytether.api.manifest import Manifest
from skytether.messages import Float64, Header, LaserScan, Time, definition_of, encode, type_hash
from skytether.service import ConfigError, ServiceError, params_schema
from skytether.testing.service import Harness
from skytether.wire.events import MessageReceived
from skytether.wire.topic import Direction, Topic
from skytether_services.recorder.service import Recorder

EPOCH = 1_700_000_000.0  # 2023-11-14 22:13:20 UTC


def recorder(folder: Path, **params: Any) -> Harness[Recorder]:
    return Harness(Recorder, params, data_dir=folder, epoch=EPOCH, now=100.0)


def offer(harness: Harness[Recorder], **encodings: str) -> None:
    """A robot connects with these topics, each of its type and encoding, `scan="ros1 sensor_msgs/msg/LaserScan"`."""
    table = []
    for name, what in encodings.items():
        encoding, type_name = what.split()
        table.append(Topic(name, type_name, Direction.IN, encoding=encoding))
    harness.connect(*table)


def read(path: Path) -> list[tuple[Any, Any, Any]]:
    with path.open("rb") as stream:
        return [(s, c, m) for s, c, m in make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False)]


def survivors(path: Path) -> list[int]:
    """Sequence numbers in a file that nobody closed, as both readers find them, which refuse a file without its end."""
    from rosbags.highlevel import AnyReader

    found = [message.sequence for _, _, message in read(path)]
    with AnyReader([path]) as reader:
        assert sum(1 for _ in reader.messages()) == len(found)
    return found


def only_file(folder: Path) -> Path:
    (path,) = folder.glob("*.mcap")
    return path


def test_what_arrives_is_in_the_file(tmp_path: Path) -> None:
    harness = recorder(tmp_path)
    offer(harness, value="cdr std_msgs/msg/Float64")
    value = encode(Float64(1.5))
    harness.send("value", value, age=0.25)
    harness.step()
    harness.stop()

    path = only_file(tmp_path)
    assert path.name == "recording-robot-20231114T221500.000Z.mcap"
    ((schema, channel, message),) = read(path)
    assert (schema.name, schema.encoding) == ("std_msgs/msg/Float64", "ros2msg")
    assert schema.data.decode() == definition_of("std_msgs/msg/Float64", "cdr") == "float64 data\n"
    assert (channel.topic, channel.message_encoding) == ("value", "cdr")
    assert channel.metadata["topic_type_hash"] == type_hash(Float64, "cdr")
    assert message.data == value
    # Arrived 100 s after the epoch, sent 0.25 s earlier.
    assert message.log_time == 1_700_000_100_000_000_000
    assert message.publish_time == 1_700_000_099_750_000_000
    with path.open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        (metadata,) = reader.iter_metadata()
    assert metadata.metadata == {"robot": "robot", "instance": "instance"}


def test_ros1_is_written_as_ros1_in_a_file_of_its_own(tmp_path: Path) -> None:
    harness = recorder(tmp_path)
    offer(harness, value="cdr std_msgs/msg/Float64", scan="ros1 sensor_msgs/msg/LaserScan")
    scan = encode(LaserScan(Header(Time(1, 2), "laser", 9), ranges=[1, 2]), "ros1")
    harness.send("value", Float64())
    harness.send("scan", scan)
    harness.send("value", Float64())
    harness.step()
    harness.stop()
    ros2, ros1 = sorted(tmp_path.iterdir(), key=lambda path: "-2.mcap" in path.name)
    assert [c.topic for _, c, _ in read(ros2)] == ["value", "value"]
    ((schema, channel, message),) = read(ros1)
    assert (schema.name, schema.encoding) == ("sensor_msgs/LaserScan", "ros1msg")
    assert "MSG: std_msgs/Header\nuint32 seq" in schema.data.decode()
    assert (channel.topic, channel.message_encoding) == ("scan", "ros1")
    assert channel.metadata["topic_type_hash"] == type_hash(LaserScan, "ros1")
    assert message.data == scan
    with ros1.open("rb") as stream:
        assert make_reader(stream).get_header().profile == "ros1"


def test_sequence_numbers_show_what_the_link_lost(tmp_path: Path) -> None:
    harness = recorder(tmp_path)
    offer(harness, value="cdr std_msgs/msg/Float64")
    for number in range(4):
        if number == 2:
            harness.skip("value")
        harness.send("value", Float64(number))
    harness.step()
    harness.stop()
    assert [m.sequence for _, _, m in read(only_file(tmp_path))] == [0, 1, 3, 4]


def test_a_robot_whose_clock_is_not_known_published_when_it_arrived(tmp_path: Path) -> None:
    harness = recorder(tmp_path)
    message = MessageReceived("value", b"", 2**32 + 5, 3.0, math.inf, 100.0)  # more messages than the format counts
    harness.service.everything.put(message, "std_msgs/msg/Float64", "cdr")
    harness.step()
    harness.stop()
    ((_, _, written),) = read(only_file(tmp_path))
    assert written.publish_time == written.log_time == 1_700_000_100_000_000_000
    assert written.sequence == 5


def test_rosbags_reads_it(tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader

    harness = recorder(tmp_path)
    offer(harness, scan="cdr sensor_msgs/msg/LaserScan")
    for number in range(3):
        harness.send("scan", LaserScan(Header(Time(number)), ranges=[number]))
        harness.step()
    harness.stop()
    with AnyReader([only_file(tmp_path)]) as reader:
        found = [
            (connection.topic, time, attrgetter("ranges")(reader.deserialize(data, connection.msgtype)).tolist())
            for connection, time, data in reader.messages()
        ]
    assert found == [("scan", 1_700_000_100_000_000_000 + n * 50_000_000, [float(n)]) for n in range(3)]


@pytest.mark.parametrize("compression", ["zstd", "none"])
def test_a_bag_that_nobody_closed_is_read_up_to_the_last_flush(tmp_path: Path, compression: str) -> None:
    from rosbags.highlevel import AnyReader

    harness = recorder(tmp_path, format="bag", flush_period=0.01, compression=compression)
    offer(harness, scan="ros1 sensor_msgs/msg/LaserScan", odd="ros1 acme_msgs/msg/Odd")
    for number in range(20):
        harness.send("scan", encode(LaserScan(Header(Time(number)), ranges=[number]), "ros1"))
        harness.send("odd", bytes(3))
        harness.step()
        with AnyReader(list(tmp_path.iterdir())) as reader:
            scans = [c for c in reader.connections if c.topic == "scan"]
            read = [cast(Any, reader.deserialize(data, c.msgtype)) for c, _, data in reader.messages(scans)]
        assert [scan.ranges[0] for scan in read] == [float(n) for n in range(number + 1)]
    harness.stop()
    with AnyReader(list(tmp_path.iterdir())) as reader:
        assert reader.message_count == 40


def test_a_type_of_which_nobody_tells_is_recorded_without_its_definition(tmp_path: Path) -> None:
    harness = recorder(tmp_path)
    offer(harness, odd="cdr acme_msgs/msg/Odd")
    harness.send("odd", b"\x00\x01\x02")
    harness.step()
    harness.stop()
    ((schema, _, message),) = read(only_file(tmp_path))
    assert (schema.name, schema.encoding, schema.data) == ("acme_msgs/msg/Odd", "", b"")
    assert message.data == b"\x00\x01\x02"


def test_a_definition_that_the_robot_tells_is_recorded(tmp_path: Path) -> None:
    harness = recorder(tmp_path)
    message = MessageReceived("odd", b"\x00\x01\x00\x00\x05", 1, 3.0, 0.0, 100.0)
    harness.service.everything.put(message, "acme_msgs/msg/Odd", "cdr", "RIHS01_5", "uint8 odd\n")
    harness.step()
    harness.stop()
    ((schema, channel, _),) = read(only_file(tmp_path))
    assert (schema.name, schema.encoding, schema.data) == ("acme_msgs/msg/Odd", "ros2msg", b"uint8 odd\n")
    assert channel.metadata["topic_type_hash"] == "RIHS01_5"


def test_a_robot_that_comes_back_with_another_type_gets_another_channel(tmp_path: Path) -> None:
    harness = recorder(tmp_path)
    for what in ("cdr std_msgs/msg/Float64", "cdr std_msgs/msg/Float32", "cdr std_msgs/msg/Float64"):
        offer(harness, value=what)
        harness.send("value", bytes(8))
        harness.step()
    harness.stop()
    found = [(c.id, s.name) for s, c, _ in read(only_file(tmp_path))]
    assert found == [(1, "std_msgs/msg/Float64"), (2, "std_msgs/msg/Float32"), (1, "std_msgs/msg/Float64")]


@pytest.mark.parametrize("compression", ["zstd", "none"])
def test_compression_is_the_params(tmp_path: Path, compression: str) -> None:
    harness = recorder(tmp_path, compression=compression)
    offer(harness, value="cdr std_msgs/msg/Float64")
    for _ in range(1000):
        harness.send("value", bytes(100))
    harness.step()
    harness.stop()
    assert len(read(only_file(tmp_path))) == 1000
    assert (only_file(tmp_path).stat().st_size < 50_000) == (compression == "zstd")


def test_a_killed_recorder_loses_at_most_the_last_flush_period(tmp_path: Path) -> None:
    harness = recorder(tmp_path, flush_period=0.99)
    offer(harness, value="cdr std_msgs/msg/Float64")
    for number in range(65):  # 20 Hz: 3.25 s, flushed at 0, 1, 2 and 3 s
        harness.send("value", Float64(number))
        harness.step()
    assert survivors(only_file(tmp_path)) == list(range(61))
    harness.stop()
    assert len(read(only_file(tmp_path))) == 65


@pytest.mark.parametrize("compression", ["zstd", "none"])
def test_a_recorder_killed_between_two_flushes_leaves_whole_files_too(tmp_path: Path, compression: str) -> None:
    harness = recorder(tmp_path, compression=compression, chunk_size=0.001, flush_period=60)
    offer(harness, value="cdr std_msgs/msg/Float64")
    kept = 0
    for number in range(50):
        harness.send("value", Float64(number))
        harness.step()
        found = survivors(only_file(tmp_path))
        assert found == list(range(len(found)))
        assert kept <= len(found) <= number + 1
        kept = len(found)
    assert kept > 10
    harness.stop()
    assert len(read(only_file(tmp_path))) == 50


def test_files_roll_over_at_their_size_and_lose_nothing(tmp_path: Path) -> None:
    harness = recorder(tmp_path, compression="none", max_size=0.05, flush_period=0.05)
    offer(harness, value="cdr std_msgs/msg/Float64")
    for _ in range(50):
        for _ in range(10):
            harness.send("value", bytes(1000))
        harness.step()
    harness.stop()
    files = sorted(tmp_path.glob("*.mcap"))
    assert len(files) == pytest.approx(500_000 / 50_000, abs=2)
    assert all(path.stat().st_size < 75_000 for path in files)
    assert [m.sequence for path in files for _, _, m in read(path)] == list(range(500))


def test_two_recordings_of_one_instant_have_two_names(tmp_path: Path) -> None:
    for _ in range(3):
        harness = recorder(tmp_path)
        offer(harness, value="cdr std_msgs/msg/Float64")
        harness.send("value", Float64())
        harness.step()
        harness.stop()
    stem = "recording-robot-20231114T221500.000Z"
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"{stem}{n}.mcap" for n in ("-2", "-3", "")]
    assert all(len(read(path)) == 1 for path in tmp_path.iterdir())


def test_without_messages_there_is_no_file(tmp_path: Path) -> None:
    harness = recorder(tmp_path / "new")
    harness.step()
    harness.stop()
    assert list((tmp_path / "new").iterdir()) == []


@contextmanager
def disk_of(size: int) -> Iterator[None]:
    """No file may grow beyond ``size``: the kernel refuses, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_ends_the_recording_with_one_sentence_and_the_service_stays_up(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    harness = recorder(tmp_path, compression="none", flush_period=0.05)
    offer(harness, value="cdr std_msgs/msg/Float64")
    with disk_of(50_000):
        for _ in range(100):
            harness.send("value", bytes(1000))
            harness.step()
        harness.stop()
    errors = [r.getMessage() for r in caplog.records if r.levelname == "ERROR"]
    assert errors == [
        f"cannot write the recording in {tmp_path} any more: File too large; "
        "it ends here, make room and start the service again"
    ]
    survived = survivors(only_file(tmp_path))
    assert survived == list(range(len(survived)))
    assert len(survived) >= 40


def test_a_disk_full_at_the_end_costs_the_index_only(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    harness = recorder(tmp_path, flush_period=0.05)
    offer(harness, value="cdr std_msgs/msg/Float64")
    for number in range(5):
        harness.send("value", Float64(number))
        harness.step()
    with disk_of(only_file(tmp_path).stat().st_size):
        harness.stop()
    assert "cannot write the recording" in caplog.text
    assert survivors(only_file(tmp_path)) == list(range(5))


def test_a_disk_full_from_the_start_leaves_no_file(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    harness = recorder(tmp_path)
    offer(harness, value="cdr std_msgs/msg/Float64")
    with disk_of(10):
        harness.send("value", Float64())
        harness.step()
        harness.stop()
    assert "cannot write the recording" in caplog.text
    assert list(tmp_path.iterdir()) == []


def test_a_data_directory_that_cannot_be_made_is_said_at_start(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ServiceError, match=r"cannot make the directory .*file/data: Not a directory"):
        recorder(tmp_path / "file" / "data")


@pytest.mark.parametrize("prefix", ["../escape", "", ".hidden", "a/b"])
def test_a_prefix_cannot_lead_out_of_the_directory(tmp_path: Path, prefix: str) -> None:
    with pytest.raises(ConfigError, match="parameter 'prefix'"):
        recorder(tmp_path, prefix=prefix)


def test_manifest_says_what_the_code_does() -> None:
    path = Path(skytether_services.recorder.__file__).with_name("service.yaml")
    manifest = Manifest.model_validate(yaml.safe_load(path.read_text()))
    assert manifest.spec.params == params_schema(Recorder)
    assert manifest.spec.entrypoint == "skytether_services.recorder"
    (topic,) = manifest.spec.topics
    (declared,) = Recorder.declared
    assert (topic.name, topic.type, topic.direction) == (declared.topic, declared.type_name, declared.direction)


def test_without_its_library_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith(("mcap", "skytether_services.recorder."))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mcap", None)
    with pytest.raises(
        SystemExit, match=r"needs the library mcap; install it with: pip install 'skytether\[recorder\]'"
    ):
        runpy.run_module("skytether_services.recorder", run_name="__main__")
