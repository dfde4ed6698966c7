"""Parameters of nodes of a ROS 2 graph."""

import struct

import pytest

from skytether.messages import DecodeError, EncodeError, decode_plain, encode_plain, hash_of
from skytether.ros.ros2.parameters import Parameters, refusals, set_request

SERVICE = "rcl_interfaces/srv/SetParameters"
# rcl_interfaces/srv/SetParameters.srv of ROS 2, in CDR by hand: no parameter refused, and one with a reason.
GRANTED = b"\0\1\0\0" + struct.pack("<IB3xI", 1, True, 1) + b"\0"
REFUSED = b"\0\1\0\0" + struct.pack("<IB3xI", 1, False, 9) + b"too fast\0"


def test_a_request_is_what_ros2_has():
    value = struct.pack("<BB2xqdI", 3, 0, 0, 0.5, 1) + b"\0\0\0\0" + 5 * struct.pack("<I", 0)
    assert set_request({"max": 0.5}) == b"\0\1\0\0" + struct.pack("<II", 1, 4) + b"max\0" + value


@pytest.mark.parametrize(
    ("value", "kind", "field"),
    [
        (True, 1, "bool_value"),
        (3, 2, "integer_value"),
        (3.0, 3, "double_value"),
        ("x", 4, "string_value"),
        ([True, False], 6, "bool_array_value"),
        ([1, 2], 7, "integer_array_value"),
        ([1.5], 8, "double_array_value"),
        (["a", "b"], 9, "string_array_value"),
    ],
)
def test_every_kind_of_value(value, kind, field):
    (parameter,) = decode_plain(f"{SERVICE}_Request", set_request({"p": value})).parameters
    found = getattr(parameter.value, field)
    assert (parameter.name, parameter.value.type) == ("p", kind)
    assert (list(found) if isinstance(value, list) else found) == value


@pytest.mark.parametrize("value", [None, {}, [], [1, 2.0], b"x"])
def test_what_can_be_no_parameter_is_named(value):
    with pytest.raises(ValueError, match="parameter speed: must be true or false, a number or a text"):
        set_request({"speed": value})


def test_refusals_are_told():
    assert refusals(GRANTED, ["max"]) == []
    assert refusals(REFUSED, ["max"]) == ["parameter max was refused: too fast"]
    with pytest.raises(DecodeError):
        refusals(b"\0\1\0\0\1", ["max"])


def test_plain_messages():
    data = encode_plain("sensor_msgs/msg/CameraInfo", {"d": [1, 2], "header": {"frame_id": "cam"}, "width": 3})
    info = decode_plain("sensor_msgs/msg/CameraInfo", data)
    assert (list(info.d), info.header.frame_id, info.width, len(info.p)) == ([1.0, 2.0], "cam", 3, 12)
    with pytest.raises(EncodeError, match="std_msgs/msg/Bool has no field 'dta'"):
        encode_plain("std_msgs/msg/Bool", {"dta": True})
    with pytest.raises(EncodeError, match="cannot write std_msgs/msg/String as cdr"):
        encode_plain("std_msgs/msg/String", {"data": 5})
    for call in (lambda: encode_plain("a/msg/B", {}), lambda: decode_plain("a/msg/B", b"")):
        with pytest.raises(KeyError):
            call()


@pytest.mark.slow
def test_a_node_is_told_whenever_it_shows_up(stage):
    dds, rihs = "rcl_interfaces::srv::dds_::SetParameters_", hash_of(SERVICE, "cdr")
    asked = []

    def answer(request):
        asked.append(request)
        return REFUSED if len(asked) > 1 else GRANTED

    with Parameters(stage.ours(), {"/bot/planner": {"max": 0.5}}):
        planner = stage.rmw("planner")
        planner.serve("/bot/planner/set_parameters", dds, rihs, answer)
        stage.until(lambda: asked, "the planner was told nothing")
        assert stage.said == []
        planner.close()
        again = stage.rmw("planner")
        stage.until(lambda: not again.sees("SS", "/bot/planner/set_parameters"), "still there")
        again.serve("/bot/planner/set_parameters", dds, rihs, answer)
        stage.until(lambda: len(asked) > 1 and stage.said, "the planner that came back was told nothing")
    assert asked == [set_request({"max": 0.5})] * 2
    assert stage.said == ["/bot/planner: parameter max was refused: too fast"]
