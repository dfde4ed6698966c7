from pathlib import Path

import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from skytether.robot.replay.bag import Bag, BagError, BagTopic
from skytether.robot.session.topic_table import Offer

SECOND = 1_000_000_000
STRING_MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"  # of std_msgs/String, as ROS 1 prints it


def write(path: Path, messages: list[tuple[str, float, bytes]], types: dict[str, str] | None = None) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer(path) as writer:
        names = sorted({topic for topic, _, _ in messages})
        of = {n: writer.add_connection(n, (types or {}).get(n, "std_msgs/msg/String"), typestore=store) for n in names}
        for topic, at, data in messages:
            writer.write(of[topic], 5 * SECOND + round(at * SECOND), data)
    return path


def test_topics_times_and_bytes_are_the_recordings_own(tmp_path):
    messages = [("/b", 0.0, b"\x01\0\0\0x"), ("/a", 0.5, b"not even a message"), ("/b", 2.0, b"")]
    with Bag(write(tmp_path / "a.bag", messages)) as bag:
        offer = Offer("std_msgs/msg/String", STRING_MD5, "ros1")
        assert bag.topics == {"/a": BagTopic(offer, 1), "/b": BagTopic(offer, 2)}
        assert bag.duration == pytest.approx(2.0)
        assert [(t, at, data) for at, t, data in bag.messages(bag.topics)] == messages
        assert [at for at, _, _ in bag.messages({"/a"})] == [0.5]
        assert list(bag.messages(set())) == []


def test_an_empty_recording_has_no_topics(tmp_path):
    with Bag(write(tmp_path / "a.bag", [])) as bag:
        assert (bag.topics, bag.duration, list(bag.messages(bag.topics))) == ({}, 0.0, [])


def test_a_missing_recording_is_told(tmp_path):
    with pytest.raises(BagError, match=r"there is no recording .*/none\.bag"):
        Bag(tmp_path / "none.bag")


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3", "a.txt"])
@pytest.mark.parametrize("content", [b"", b"\xff\x83 no bag at all", b"#ROSBAG V2.0\n"])
def test_what_is_no_recording_is_told(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(BagError, match=f"{name} is no recording that can be read") as caught:
        Bag(path)
    assert "codec" not in str(caught.value), "for people"


def test_a_folder_that_is_no_recording_is_told(tmp_path):
    with pytest.raises(BagError, match=r"is no recording: a ROS 2 bag's has a metadata\.yaml"):
        Bag(tmp_path)


def test_a_recording_that_was_cut_off_is_told(tmp_path):
    path = write(tmp_path / "a.bag", [("/a", float(i), bytes(100)) for i in range(50)])
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(BagError, match=r"a\.bag"), Bag(path) as bag:
        list(bag.messages(bag.topics))


@pytest.mark.data
def test_a_real_recording(data_dir):
    with Bag(data_dir / "legs" / "stationary_simple.bag") as bag:
        offer = Offer("sensor_msgs/msg/LaserScan", "90c7ef2dc6895d81024acba2ac42f369", "ros1")
        assert bag.topics == {"/scan": BagTopic(offer, 1265)}
        assert bag.duration == pytest.approx(125.989, abs=1e-3)
        messages = list(bag.messages({"/scan"}))
    assert len(messages) == 1265
    assert messages[0][0] == 0.0
    assert {len(data) for _, _, data in messages} == {2105}
