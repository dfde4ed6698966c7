from __future__ import annotations

import dataclasses
from contextlib import suppress
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from skytether.messages import (
    CompressedImage,
    DecodeError,
    EncodeError,
    Encoding,
    Float64,
    Header,
    JointState,
    LaserScan,
    Marker,
    MarkerArray,
    Message,
    OccupancyGrid,
    Odometry,
    Path,
    PoseStamped,
    PoseWithCovariance,
    Range,
    TFMessage,
    Time,
    Twist,
    Vector3,
    all_types,
    decode,
    definition_of,
    encode,
    hash_of,
    transcode,
    type_hash,
    type_of,
    warm,
)
from skytether.messages.action_definitions import ACTIONS
from skytether.messages.codec import typestore
from skytether.messages.definitions import definitions
from skytether.messages.services import BOTH, service_types

ENCODINGS: tuple[Encoding, ...] = ("cdr", "ros1")
INTEGERS = {
    "int8": (-(2**7), 2**7 - 1),
    "uint8": (0, 2**8 - 1),
    "int16": (-(2**15), 2**15 - 1),
    "uint16": (0, 2**16 - 1),
    "int32": (-(2**31), 2**31 - 1),
    "uint32": (0, 2**32 - 1),
}


@cache
def untouched_store(encoding: Encoding) -> Typestore:
    """rosbags with its own classes: the oracle."""
    store = get_typestore(Stores.ROS2_JAZZY if encoding == "cdr" else Stores.ROS1_NOETIC)
    if encoding == "ros1":
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
        store.register(get_types_from_msg("float32 u\nfloat32 v", "visualization_msgs/msg/UVCoordinate"))
        store.register(get_types_from_msg("string filename\nuint8[] data", "visualization_msgs/msg/MeshFile"))
    for name, parts in BOTH.items():
        store.register(service_types(name, *parts, hashed=False))
    for name, fields in ACTIONS.items():
        if name not in store.fielddefs:
            ((_, definition),) = get_types_from_msg(fields.replace(", ", "\n"), "any/msg/Part").items()
            store.register({name: definition})
    return store


def scalars(name: str) -> st.SearchStrategy[Any]:
    if name == "string":
        return st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=12)
    if name == "bool":
        return st.booleans()
    if name.startswith("float"):
        return st.floats(width=32 if name == "float32" else 64)
    return st.integers(*INTEGERS[name])


def arrays(name: str, least: int, most: int) -> st.SearchStrategy[Any]:
    size = np.dtype(name).itemsize
    return st.integers(least, most).flatmap(
        lambda n: st.binary(min_size=n * size, max_size=n * size).map(lambda b: np.frombuffer(b, name))
    )


@cache
def random_messages(typename: str, encoding: Encoding) -> st.SearchStrategy[Any]:
    """Messages of rosbags' own class, any values that the type has room for."""
    store = untouched_store(encoding)

    def value(desc: Any) -> st.SearchStrategy[Any]:
        kind, what = desc
        if kind == Nodetype.BASE:
            return scalars(what[0])
        if kind == Nodetype.NAME:
            return random_messages(what, encoding)
        (inner_kind, inner), length = what
        least, most = (length, length) if kind == Nodetype.ARRAY else (0, 5)
        if inner_kind == Nodetype.BASE and inner[0] != "string":
            return arrays(inner[0], least, most)
        return st.lists(value((inner_kind, inner)), min_size=least, max_size=most)

    return st.builds(store.types[typename], *(value(desc) for _, desc in store.fielddefs[typename][1]))


def oracle_bytes(message: Any, typename: str, encoding: Encoding) -> bytes:
    store = untouched_store(encoding)
    write = store.serialize_cdr if encoding == "cdr" else store.serialize_ros1
    return bytes(write(message, typename))


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("cls", all_types(), ids=lambda cls: cls.__name__)
def test_bytes_of_rosbags_come_back_identical(cls: type[Message], encoding: Encoding) -> None:
    @settings(max_examples=4)
    @given(random_messages(cls.TYPE, encoding))
    def check(theirs: Any) -> None:
        data = oracle_bytes(theirs, cls.TYPE, encoding)
        ours = decode(cls, data, encoding)
        assert type(ours) is cls
        assert encode(ours, encoding) == data
        assert decode(cls, data, encoding) == ours

    check()


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("cls", all_types(), ids=lambda cls: cls.__name__)
def test_fields_are_the_definitions_fields(cls: type[Message], encoding: Encoding) -> None:
    """Same names in the same order, besides those that only one of the two generations has."""
    theirs = [name for name, _ in untouched_store(encoding).fielddefs[cls.TYPE][1] if name != "seq"]
    ours = [field.name for field in dataclasses.fields(cls)]
    assert [name for name in ours if name in theirs] == theirs
    more = {"Header": {"seq"}}
    if encoding == "ros1":
        more |= {"Range": {"variance"}}
        more |= {"Marker": {"texture_resource", "texture", "uv_coordinates", "mesh_file"}}
    assert set(ours) - set(theirs) == more.get(cls.__name__, set())


@pytest.mark.data
@pytest.mark.parametrize(("bag", "count"), [("stationary_simple", 1265), ("positive_7", 510)])
def test_every_recorded_scan_comes_back_identical(data_dir: Any, bag: str, count: int) -> None:
    from rosbags.rosbag1 import Reader

    seen = 0
    with Reader(data_dir / "legs" / f"{bag}.bag") as reader:
        for connection, _, data in reader.messages():
            assert connection.digest == type_hash(LaserScan, "ros1")
            scan = decode(connection.msgtype, data, "ros1")
            assert isinstance(scan, LaserScan)
            assert scan.ranges.size > 0
            assert encode(scan, "ros1") == data
            through_ros2 = decode(LaserScan, encode(scan))
            assert np.array_equal(through_ros2.ranges, scan.ranges, equal_nan=True)
            assert through_ros2.header.stamp == scan.header.stamp
            seen += 1
    assert seen == count


@settings(max_examples=100)
@given(st.sampled_from(all_types()), st.sampled_from(ENCODINGS), st.binary(max_size=200))
def test_any_bytes_give_a_message_or_a_decode_error(cls: type[Message], encoding: Encoding, data: bytes) -> None:
    with suppress(DecodeError):
        assert type(decode(cls, data, encoding)) is cls


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("cls", all_types(), ids=lambda cls: cls.__name__)
def test_every_truncation_is_refused(cls: type[Message], encoding: Encoding) -> None:
    whole = encode(cls(), encoding)
    for length in range(0, len(whole), max(1, len(whole) // 40)):
        with pytest.raises(DecodeError, match=cls.TYPE):
            decode(cls, whole[:length], encoding)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_bytes_left_over_are_refused(encoding: Encoding) -> None:
    with pytest.raises(DecodeError, match="geometry_msgs/msg/Twist"):
        decode(Twist, encode(Twist(), encoding) + bytes(8), encoding)


def test_big_endian_cdr_is_read() -> None:
    store = untouched_store("cdr")
    little = decode(JointState, encode(JointState(position=np.array([1.5, -2.0]))))
    theirs = store.deserialize_cdr(encode(little), JointState.TYPE)
    assert decode(JointState, bytes(store.serialize_cdr(theirs, JointState.TYPE, little_endian=False))) == little


def test_ros1_header_keeps_its_sequence_number_and_ros2_has_none() -> None:
    header = Header(Time(1, 2), "base", seq=7)
    assert encode(header, "ros1")[:4] == (7).to_bytes(4, "little")
    assert encode(Header(), "ros1")[:4] == bytes(4)
    assert decode(Header, encode(header, "ros1"), "ros1") == header
    assert decode(Header, encode(header)) == Header(Time(1, 2), "base")


def test_range_has_a_variance_in_ros2_only() -> None:
    reading = Range(range=1.0, variance=0.5)
    assert decode(Range, encode(reading)).variance == 0.5
    assert decode(Range, encode(reading, "ros1"), "ros1") == Range(range=1.0)


def test_a_marker_has_textures_in_ros2_only() -> None:
    marker = Marker(text="stopped", mesh_use_embedded_materials=True, texture_resource="file:///wood.png")
    assert decode(Marker, encode(marker)) == marker
    assert decode(Marker, encode(marker, "ros1"), "ros1") == dataclasses.replace(marker, texture_resource="")


@pytest.mark.parametrize(
    "message",
    [
        Float64("fast"),
        Time(sec=2**31),
        Time(nanosec=-1),
        Twist(linear=None),
        JointState(name=[1]),  # type: ignore[list-item]
        Path(poses=[Twist()]),  # type: ignore[list-item]
    ],
    ids=lambda message: repr(message)[:40],
)
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_values_without_room_name_the_type(message: Message, encoding: Encoding) -> None:
    with pytest.raises(EncodeError, match=message.TYPE):
        encode(message, encoding)


def test_unknown_names_say_what_there_is() -> None:
    with pytest.raises(KeyError, match=r"Twizt.*geometry_msgs/msg/Twist"):
        type_of("geometry_msgs/msg/Twizt")
    with pytest.raises(KeyError, match="Twizt"):
        decode("geometry_msgs/msg/Twizt", b"")
    with pytest.raises(ValueError, match=r"'json'.*'cdr'"):
        encode(Twist(), "json")


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_definitions_kept_here_are_those_of_rosbags(encoding: Encoding) -> None:
    every = typestore(encoding).fielddefs
    kept = definitions(encoding)
    assert kept == {name: every[name] for name in kept}
    assert kept.keys() == {cls.TYPE for cls in all_types()}, "each class needs its row in definitions.py"


def test_hashes_are_those_that_ros_uses() -> None:
    """MD5 as `rosmsg md5` of Noetic prints them, RIHS01 as `ros2 topic info -v` of Jazzy does."""
    assert type_hash(LaserScan, "ros1") == "90c7ef2dc6895d81024acba2ac42f369"
    assert type_hash(Twist, "ros1") == "9f195f881246fdfa2798d1d3eebca84a"
    assert type_hash(Odometry, "ros1") == "cd5e73d190d741a2f92e81eda573aca7"
    assert type_hash(TFMessage, "ros1") == "94810edda583a504dfda3829e70d7eec"
    assert type_hash(MarkerArray, "ros1") == "d155b9ce5188fbaf89745847fd5882d7"
    assert type_hash(Twist, "cdr") == "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a"


def test_hashes_of_actions() -> None:
    """As the messages of Debian's python3-move-base-msgs have them; of ROS 2's calls there is one from their parts."""
    assert hash_of("move_base_msgs/msg/MoveBaseActionGoal", "ros1") == "660d6895a1b9a16dce51fbdd9a64a56b"
    assert hash_of("move_base_msgs/msg/MoveBaseActionResult", "ros1") == "1eb06eeff08fa7ea874431638cb52332"
    assert hash_of("move_base_msgs/msg/MoveBaseActionFeedback", "ros1") == "7d1870ff6e0decea702b943b5af0b42e"
    for part in ("SendGoal", "GetResult", "FeedbackMessage"):
        assert hash_of(f"nav2_msgs/action/NavigateToPose_{part}", "cdr").startswith("RIHS01_")


def test_hashes_and_definitions_of_types_that_have_no_class_here() -> None:
    assert hash_of("sensor_msgs/msg/CameraInfo", "ros1") == "c9a58c1b0b154e0e6da7578cb991d214"
    assert hash_of("sensor_msgs/msg/CameraInfo", "cdr").startswith("RIHS01_")
    assert "float64[9] K" in definition_of("sensor_msgs/msg/CameraInfo", "ros1")
    for encoding in ENCODINGS:
        assert hash_of("acme_msgs/msg/Secret", encoding) == ""
        assert definition_of("acme_msgs/msg/Secret", encoding) == ""


def test_definition_holds_what_it_needs() -> None:
    assert definition_of("std_msgs/msg/Header", "ros1").splitlines()[:3] == [
        "uint32 seq",
        "time stamp",
        "string frame_id",
    ]
    assert "MSG: builtin_interfaces/Time" in definition_of("std_msgs/msg/Header", "cdr")


def test_warm_leaves_nothing_to_compile(monkeypatch: pytest.MonkeyPatch) -> None:
    def compiled(*args: object) -> None:
        pytest.fail(f"compiled while messages arrive: {args[0]}")

    for encoding in ENCODINGS:
        warm(all_types(), encoding)
    monkeypatch.setattr("rosbags.typesys.store.Msgdef", compiled)
    for encoding in ENCODINGS:
        for cls in all_types():
            decode(cls, encode(cls(), encoding), encoding)


def test_arrays_are_converted_once_and_kept_when_right() -> None:
    right = np.array([1.0, 2.0], np.float32)
    assert LaserScan(ranges=right).ranges is right
    scan = LaserScan(ranges=[1, 2])
    assert scan.ranges.dtype == np.float32
    assert scan == LaserScan(ranges=right)
    assert CompressedImage(data=b"\xff\xd8").data.tolist() == [255, 216]
    assert OccupancyGrid(data=np.array([[0, 100], [-1, 0]])).data.tolist() == [0, 100, -1, 0]
    strided = np.arange(10, dtype=np.float64)[::2]
    assert decode(JointState, encode(JointState(position=strided))).position.tolist() == strided.tolist()


def test_covariance_has_36_values() -> None:
    assert PoseWithCovariance(covariance=np.eye(6)).covariance.shape == (36,)
    with pytest.raises(ValueError, match=r"PoseWithCovariance: covariance needs 36 values, not 3"):
        PoseWithCovariance(covariance=np.zeros(3))


def test_messages_are_values() -> None:
    assert Twist() == Twist(linear=Vector3())
    assert Twist() != Twist(linear=Vector3(x=0.1))
    assert Vector3() != Header()
    assert Vector3(x=float("nan")) == Vector3(x=float("nan"))
    nan = LaserScan(ranges=np.array([np.nan, 1], np.float32))
    assert nan == LaserScan(ranges=np.array([np.nan, 1], np.float32))
    assert nan != LaserScan(ranges=np.array([np.nan, 2], np.float32))
    assert Path(poses=[PoseStamped()]) == Path(poses=(PoseStamped(),))
    assert Path(poses=[PoseStamped()]) != Path()
    assert hash(Twist()) == hash(Twist(linear=Vector3()))
    with pytest.raises(dataclasses.FrozenInstanceError):
        Twist().linear = Vector3()
    with pytest.raises(ValueError, match="read-only"):
        PoseWithCovariance().covariance[0] = 1


def test_more_elements_than_there_are_bytes_are_refused_before_each_is_looked_at() -> None:
    with pytest.raises(DecodeError, match="Invalid sequence length 4000000000"):
        transcode("geometry_msgs/msg/Polygon", (4_000_000_000).to_bytes(4, "little"), "ros1", "cdr")
    with pytest.raises(DecodeError, match="Invalid sequence length 4000000000"):
        transcode("geometry_msgs/msg/Polygon", b"\0\1\0\0" + (4_000_000_000).to_bytes(4, "little"), "cdr", "ros1")
