import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.messages import Header, TFMessage, Transform, TransformStamped, Vector3, decode, encode
from skytether.ros.notes import MAX_NOTES, NOTES, Notes, TypeNote, topics, unpack
from skytether.ros.static_tf import StaticTransforms
from skytether.wire.topic import Role

NOTE = TypeNote("my_msgs/Own", "0" * 32, "int32 x\n")


def test_what_is_told_arrives():
    notes = Notes({"chat": NOTE}, {"lamp": TypeNote("std_srvs/SetBool", "1" * 32)}, {"/a": {"b": [1, 2.5, "x"]}})
    assert unpack(notes.pack()) == notes


def test_a_parameter_that_cannot_travel_is_named_and_the_others_go_on(caplog):
    notes = unpack(Notes(params={"/bytes": b"\x00", "/big": "x" * MAX_NOTES, "/fine": True}).pack())
    assert notes.params == {"/fine": True}
    assert "parameter /bytes cannot be handed over" in caplog.text
    assert "parameter /big cannot be handed over: it is too large" in caplog.text


@pytest.mark.parametrize("data", [b"", b"\xff", b"[]", b"7", b"[" * 100_000, bytes(MAX_NOTES + 1)])
def test_nonsense_is_no_note(data):
    assert unpack(data) is None


@settings(max_examples=20)
@given(st.recursive(st.none() | st.integers() | st.text(), lambda x: st.lists(x) | st.dictionaries(st.text(), x)))
def test_any_document_is_read_as_far_as_it_makes_sense(value):
    notes = unpack(json.dumps({"types": value, "services": value, "params": value}).encode())
    assert all(isinstance(note, TypeNote) for note in notes.types.values())
    assert isinstance(notes.params, dict)


def test_both_ends_have_the_same_rows_one_each_way():
    rows = {topic.direction.sender: topic.name for topic in topics()}
    assert rows == NOTES == {Role.ROBOT: "skytether/graph/robot", Role.SERVICE: "skytether/graph/service"}
    assert all(topic.reliable and topic.latched for topic in topics())


def transform(child, x):
    return TransformStamped(Header(frame_id="base"), child, Transform(Vector3(x=x)))


@pytest.mark.parametrize("encoding", ["ros1", "cdr"])
def test_static_transforms_of_all_publishers_are_kept_the_newest_of_each_frame(encoding):
    merge = StaticTransforms(encoding).merge
    first = encode(TFMessage([transform("laser", 1.0), transform("camera", 2.0)]), encoding)
    assert merge(first) == first
    both = merge(encode(TFMessage([transform("laser", 3.0)]), encoding))
    assert decode(TFMessage, both, encoding) == TFMessage([transform("laser", 3.0), transform("camera", 2.0)])
    assert merge(b"\x07") == b"\x07"
