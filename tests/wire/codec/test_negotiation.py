"""Joining the topic tables."""

import json
import zlib
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.wire import Direction, Topic
from skytether.wire.codec.negotiation import (
    TablesDifferError,
    index_topics,
    negotiate,
    pull_answer,
    pull_offer,
    push_answer,
    push_offer,
)

IN, OUT = Direction.IN, Direction.OUT
names = st.text(min_size=1, max_size=20)
topics = st.lists(
    st.builds(
        Topic, names, names, st.sampled_from(Direction), names, names, st.integers(0, 127),
        st.none() | st.floats(0.001, 100), st.floats(0.001, 3600), st.integers(1, 10_000), st.floats(0.01, 0.99),
    ),
    unique_by=lambda t: t.name, max_size=20,
)  # fmt: skip


@given(topics)
@settings(max_examples=40)
def test_tables_travel(table):
    offered = pull_offer(push_offer(table))
    assert [(t.name, t.type, t.direction, t.type_hash, t.encoding) for t in offered] == [
        (t.name, t.type, t.direction, t.type_hash, t.encoding) for t in table
    ]
    agreed = list(enumerate(table, 1))
    assert pull_answer(push_answer(agreed), table) == agreed


@given(st.binary(max_size=200))
def test_bytes_that_are_no_table_are_a_value_error(data):
    for pull in (pull_offer, lambda d: pull_answer(d, [])):
        with pytest.raises(ValueError, match="table"):
            pull(data)


def test_quality_is_the_services_and_encoding_the_robots():
    robot = [Topic("a", "x/y", IN, "h", "ros1", priority=1), Topic("mine", "x/y", IN), Topic("b", "x/y", OUT)]
    service = index_topics([Topic("b", "x/y", OUT, priority=9), Topic("a", "x/y", IN, "", "cdr", priority=7, depth=3)])
    assert negotiate(robot, service) == [
        (1, Topic("a", "x/y", IN, "h", "ros1", priority=7, depth=3)),
        (3, Topic("b", "x/y", OUT, priority=9)),
    ]


def test_a_star_takes_what_the_robot_sends_and_named_rows_go_first():
    service = index_topics([Topic("*", "*", IN, depth=50), Topic("a", "x/y", IN, depth=3)])
    robot = [Topic("a", "x/y", IN), Topic("b", "any/thing", IN, "h"), Topic("c", "x/y", OUT)]
    assert negotiate(robot, service) == [
        (1, Topic("a", "x/y", IN, depth=3)),
        (2, Topic("b", "any/thing", IN, "h", depth=50)),
    ]


@pytest.mark.parametrize(
    ("robot", "service", "words"),
    [
        (Topic("a", "x/y", IN), Topic("a", "x/z", IN), ["a", "type", "x/y", "x/z"]),
        (Topic("a", "x/y", IN), Topic("a", "x/y", OUT), ["a", "direction", "in", "out"]),
        (Topic("a", "x/y", IN, "11"), Topic("a", "x/y", IN, "22"), ["a", "type hash", "11", "22"]),
    ],
)
def test_what_cannot_be_joined_is_named(robot, service, words):
    with pytest.raises(TablesDifferError) as error:
        negotiate([robot], index_topics([service]))
    assert all(word in str(error.value) for word in words)


def test_a_hash_that_one_end_does_not_know_is_no_difference():
    [(_, agreed)] = negotiate([Topic("a", "x/y", IN)], index_topics([Topic("a", "x/y", IN, "h")]))
    assert agreed.type_hash == "h"


def test_a_topic_listed_twice_is_refused():
    with pytest.raises(ValueError, match="topic a: is in the table twice"):
        index_topics([Topic("a", "x/y", IN), Topic("a", "x/z", OUT)])


def test_hashes_of_two_encodings_are_not_compared():
    """An MD5 of ROS 1 and a RIHS01 of ROS 2 say nothing of each other; what the robot has is agreed on."""
    robot, service = Topic("a", "x/y", IN, "11", "ros1"), Topic("a", "x/y", IN, "RIHS01_22", "cdr")
    ((_, agreed),) = negotiate([robot], {"a": service})
    assert (agreed.type_hash, agreed.encoding) == ("11", "ros1")
    ((_, agreed),) = negotiate([replace(robot, type_hash="")], {"a": service})
    assert agreed.type_hash == ""


def test_a_table_of_many_rows_is_refused_at_once():
    """Of many names the last twice, and more rows than there may be: to compare each with each takes seconds."""
    rows = [[f"t{i}", "a/msg/B", "in", "", ""] for i in range(8000)]
    for table in ([*rows, rows[-1]], [rows[0]] * 65_536):
        with pytest.raises(ValueError, match=r"t7999: is in the table twice|more topics"):
            pull_offer(zlib.compress(json.dumps(table).encode()))
