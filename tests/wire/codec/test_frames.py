"""Frames."""

import math

from hypothesis import given
from hypothesis import strategies as st

from skytether.wire.codec.frames import (
    MISSING_ROWS,
    MOST_ASTRAY,
    MOST_RUN,
    PING_SIZE,
    Ack,
    Feedback,
    Forward,
    Goodbye,
    Missing,
    Ping,
    ReceiverRow,
    Report,
    SenderRow,
    pull_frame,
    push_ack,
    push_forward,
    push_goodbye,
    push_missing,
    push_ping,
    push_reports,
)

counter = st.integers(0, 2**64 - 1)
seconds = st.floats(0, 1e6, width=32) | st.just(math.inf)
senders = st.builds(SenderRow, st.integers(0, 65_535), st.integers(0, 2**32 - 1), *[counter] * 6)
amount = st.floats(0, 1e9, width=32)
sums = st.integers(0, 2**32 - 1)
feedback = st.builds(Feedback, seconds, amount, amount, sums, sums, sums, amount, amount)
NOTHING = Feedback(math.inf, 0.0, 0.0, 0, 0, 0, 0.0, 0.0)
runs = st.lists(st.tuples(st.integers(0, 2**32 - 1), st.integers(0, MOST_RUN)), max_size=MOST_ASTRAY).map(tuple)
receivers = st.builds(ReceiverRow, st.integers(0, 65_535), *[counter] * 7, *[seconds] * 8)


@given(
    st.builds(
        Ping, st.integers(0, 255), st.integers(0, 255), st.booleans(), st.integers(0, 65_535),
        st.none() | st.integers(0, 2**64 - 2), st.integers(0, 2**64 - 1), st.integers(0, 2**32 - 1), feedback, runs,
    ),
    st.integers(0, 1400),
)  # fmt: skip
def test_pings_travel(ping, padding):
    data = push_ping(ping, padding)
    assert pull_frame(data) == ping
    assert len(data) == PING_SIZE + padding + (1 + 6 * len(ping.astray) if ping.astray else 0)
    # An end that knows nothing of what follows the fixed part, and one that says nothing there.
    assert pull_frame(data[:PING_SIZE]) == ping._replace(astray=())


def test_of_many_runs_the_last_are_told_and_more_than_there_can_be_are_none():
    ping = Ping(0, 0, True, 0, 1, 0, 0, NOTHING, tuple((number, 1) for number in range(100)))
    assert pull_frame(push_ping(ping)).astray == ping.astray[-MOST_ASTRAY:]
    fixed = push_ping(ping._replace(astray=()))
    assert pull_frame(fixed + bytes([MOST_ASTRAY + 1]) + bytes(1000)).astray == ()
    assert pull_frame(fixed + bytes([2]) + bytes(11)) is None


def test_a_hold_beyond_all_bounds_is_cut():
    cut = Ping(0, 0, True, 0, 1, 0, 2**32 - 1, NOTHING)
    assert pull_frame(push_ping(cut._replace(hold=2**40))) == cut


def test_sums_wrap_and_feedback_that_makes_no_sense_is_refused():
    ping = Ping(0, 0, True, 0, 1, 0, 0, NOTHING)
    wrapped = pull_frame(push_ping(ping._replace(feedback=NOTHING._replace(settled=2**32 + 5))))
    assert wrapped.feedback.settled == 5
    for field in ("queue", "rate", "time", "time_squared"):
        for wrong in (math.nan, -1.0, math.inf):
            assert pull_frame(push_ping(ping._replace(feedback=NOTHING._replace(**{field: wrong})))) is None
    for wrong in (math.nan, -math.inf):
        assert pull_frame(push_ping(ping._replace(feedback=NOTHING._replace(capacity=wrong)))) is None


def test_goodbye_travels():
    assert pull_frame(push_goodbye()) == Goodbye()


@given(st.lists(senders, max_size=60), st.lists(receivers, max_size=60))
def test_reports_travel_in_packets(sent, received):
    messages = list(push_reports(sent, received))
    assert all(len(m) < 1024 for m in messages)
    reports = [pull_frame(m) for m in messages]
    assert all(isinstance(r, Report) for r in reports)
    assert [row for r in reports for row in r.senders] == sent
    assert [row for r in reports for row in r.receivers] == received


@given(st.binary(max_size=300))
def test_any_bytes_are_read_or_refused(data):
    assert pull_frame(data) is None or data[0] in range(1, 7)
    for kind in range(1, 7):
        pull_frame(bytes([kind]) + data)


numbers = st.integers(0, 2**64 - 1)
indices = st.integers(0, 2**16 - 1)


@given(
    st.builds(Ack, indices, numbers, st.binary(max_size=128)),
    st.builds(
        Missing, indices, numbers, indices,
        st.lists(st.tuples(indices, st.binary(min_size=13, max_size=13)), max_size=MISSING_ROWS).map(tuple),
    ),
    st.builds(Forward, indices, numbers),
)  # fmt: skip
def test_frames_travel_in_a_packet(ack, missing, forward):
    assert pull_frame(push_ack(ack)) == ack
    assert pull_frame(push_missing(missing)) == missing
    assert pull_frame(push_forward(forward)) == forward
    assert len(push_missing(missing)) < 1024
