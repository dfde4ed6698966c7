"""Bytes of ROS 1 as those of ROS 2 and back."""

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from skytether.messages import DecodeError, LaserScan, Range, Twist, Vector3, all_types, encode, hash_of
from skytether.messages.action_definitions import ONE_GENERATION
from skytether.ros.convert import NoConversionError, converter


def is_of_one_generation(cls):
    return cls.TYPE.startswith(ONE_GENERATION)


@pytest.mark.parametrize("cls", [c for c in all_types() if not is_of_one_generation(c)], ids=lambda c: c.TYPE)
def test_every_type_of_ours_goes_there_and_back(cls):
    ros1, cdr = encode(cls(), "ros1"), encode(cls(), "cdr")
    there, back = converter(cls.TYPE, "ros1", "cdr"), converter(cls.TYPE, "cdr", "ros1")
    assert there is not None
    assert back is not None
    assert there(ros1) == cdr
    assert back(memoryview(cdr)) == ros1


@pytest.mark.parametrize("cls", [c for c in all_types() if is_of_one_generation(c)], ids=lambda c: c.TYPE)
def test_messages_of_actions_are_of_one_generation(cls):
    for there in (("ros1", "cdr"), ("cdr", "ros1")):
        with pytest.raises(NoConversionError, match=cls.TYPE):
            converter(cls.TYPE, *there)


def test_what_is_the_same_is_not_touched():
    assert converter("any/msg/Thing", "cdr", "cdr") is None


def test_values_survive():
    scan = LaserScan(angle_min=-1.0, ranges=[1.0, float("inf"), 2.0])
    for message in (Twist(Vector3(1, 2, 3), Vector3(0, 0, -1)), scan, Range(range=2.5)):
        there = converter(message.TYPE, "ros1", "cdr")
        assert there is not None
        assert there(encode(message, "ros1")) == encode(message, "cdr")


def test_types_without_a_class_are_taken_by_their_fields():
    # CameraInfo's fields have upper case in ROS 1 (D, K, R, P); independent decoding by the other generation's store.
    ros1, ros2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_JAZZY)
    t = ros1.types
    header = t["std_msgs/msg/Header"](7, t["builtin_interfaces/msg/Time"](1, 2), "cam")
    roi = t["sensor_msgs/msg/RegionOfInterest"](1, 2, 3, 4, True)
    name, numbers = "sensor_msgs/msg/CameraInfo", np.arange(12.0)
    info = t[name](header, 480, 640, "plumb_bob", numbers[:5], numbers[:9], numbers[:9], numbers, 1, 2, roi)
    there, back = converter(name, "ros1", "cdr"), converter(name, "cdr", "ros1")
    assert there is not None
    assert back is not None
    converted = there(ros1.serialize_ros1(info, name))
    seen = ros2.deserialize_cdr(converted, name)
    assert (seen.header.frame_id, seen.header.stamp.nanosec, list(seen.p), seen.roi.do_rectify) == (
        "cam",
        2,
        list(numbers),
        True,
    )
    again = ros1.deserialize_ros1(back(converted), name)
    assert (again.header.seq, again.header.frame_id, list(again.D)) == (0, "cam", list(numbers[:5]))


@pytest.mark.parametrize(("seconds", "nanoseconds"), [(1, 999_999_999), (-2, 5)])
def test_durations_arrive_to_the_nanosecond(seconds, nanoseconds):
    ros1, ros2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_JAZZY)
    name, none = "trajectory_msgs/msg/JointTrajectoryPoint", np.zeros(0)
    duration = ros1.types["builtin_interfaces/msg/Duration"](seconds, nanoseconds)
    sent = ros1.types[name](np.arange(2.0), none, none, none, duration)
    there = converter(name, "ros1", "cdr")
    assert there is not None
    seen = ros2.deserialize_cdr(there(ros1.serialize_ros1(sent, name)), name)
    assert (seen.time_from_start.sec, seen.time_from_start.nanosec) == (seconds, nanoseconds)
    assert list(seen.positions) == [0.0, 1.0]


def test_services_of_both_generations():
    for part, ros1, cdr in (
        ("_Request", b"", bytes([0, 1, 0, 0, 0])),
        ("_Response", b"\1\2\0\0\0ok", bytes([0, 1, 0, 0, 1, 0, 0, 0, 3, 0, 0, 0]) + b"ok\0"),
    ):
        there = converter(f"std_srvs/srv/Trigger{part}", "ros1", "cdr")
        back = converter(f"std_srvs/srv/Trigger{part}", "cdr", "ros1")
        assert there is not None
        assert back is not None
        assert there(ros1) == cdr
        assert back(cdr) == ros1


@pytest.mark.parametrize("name", ["shape_msgs/msg/SolidPrimitive", "my_msgs/msg/Own", "action_msgs/msg/GoalStatus"])
def test_what_differs_is_refused_by_name(name):
    with pytest.raises(NoConversionError, match=f"{name} cannot be turned from ROS 1 into ROS 2: the codec knows no"):
        converter(name, "ros1", "cdr")


@pytest.mark.parametrize("name", ["geometry_msgs/msg/Twist", "sensor_msgs/msg/Image"])
@pytest.mark.parametrize("source", ["ros1", "cdr"])
def test_bytes_that_are_no_such_message(name, source):
    convert = converter(name, source, "cdr" if source == "ros1" else "ros1")
    assert convert is not None
    for data in (b"", b"\0\1\0\0", bytes(range(40)), b"\xff" * 50):
        with pytest.raises(DecodeError, match=f"are no {name} in {source}"):
            convert(data)


# Published hashes: ros2/rmw_zenoh docs/design.md (String, AddTwoInts); `ros2 topic info -v` and `ros2 service info` of
# Jazzy as public bug reports and packages show them (the rest).
PUBLISHED = {
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "geometry_msgs/msg/Twist": "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    "geometry_msgs/msg/Pose": "d501954e9476cea2996984e812054b68026ae0bfae789d9a10b23daf35cc90fa",
    "sensor_msgs/msg/LaserScan": "64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828",
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "builtin_interfaces/msg/Time": "b106235e25a4c5ed35098aa0a61a3ee9c9b18d197f398b0e4206cea9acf9c197",
    "example_interfaces/srv/AddTwoInts": "e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a",
    "std_srvs/srv/Trigger": "eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_hashes_are_the_published_ones(name):
    assert hash_of(name, "cdr") == f"RIHS01_{PUBLISHED[name]}"


def test_hashes_that_are_not_known():
    assert hash_of("my_msgs/msg/Own", "cdr") == hash_of("std_srvs/srv/Trigger", "ros1") == ""
