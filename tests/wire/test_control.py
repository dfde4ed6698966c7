"""Control messages."""

import math

from hypothesis import given
from hypothesis import strategies as st

from skytether.wire.control import (
    PING_SIZE,
    Goodbye,
    Ping,
    ReceiverRow,
    Report,
    SenderRow,
    pull_control,
    push_goodbye,
    push_ping,
    push_reports,
)

counter = st.integers(0, 2**64 - 1)
seconds = st.floats(0, 1e6, width=32) | st.just(math.inf)
senders = st.builds(SenderRow, st.integers(0, 65_535), st.integers(0, 2**32 - 1), *[counter] * 6)
receivers = st.builds(ReceiverRow, st.integers(0, 65_535), *[counter] * 7, *[seconds] * 8)


@given(
    st.builds(
        Ping, st.integers(0, 255), st.integers(0, 255), st.booleans(), st.integers(0, 65_535),
        st.none() | st.integers(0, 2**64 - 2), st.integers(0, 2**32 - 1),
    ),
    st.integers(0, 1400),
)  # fmt: skip
def test_pings_travel(ping, padding):
    data = push_ping(ping, padding)
    assert pull_control(data) == ping
    assert len(data) == PING_SIZE + padding


def test_a_hold_beyond_all_bounds_is_cut():
    assert pull_control(push_ping(Ping(0, 0, True, 0, 1, 2**40))) == Ping(0, 0, True, 0, 1, 2**32 - 1)


def test_goodbye_travels():
    assert pull_control(push_goodbye()) == Goodbye()


@given(seconds, seconds, st.lists(senders, max_size=60), st.lists(receivers, max_size=60))
def test_reports_travel_in_packets(loss, burst, sent, received):
    messages = list(push_reports(3, loss, burst, sent, received))
    assert all(len(m) < 1024 for m in messages)
    reports = [pull_control(m) for m in messages]
    assert all(isinstance(r, Report) for r in reports)
    assert [row for r in reports for row in r.senders] == sent
    assert [row for r in reports for row in r.receivers] == received
    assert all(r.path == 3 for r in reports)
    assert reports[0].loss == loss or math.isnan(reports[0].loss)


@given(st.binary(max_size=300))
def test_any_bytes_are_read_or_refused(data):
    assert pull_control(data) is None or data[0] in (1, 2, 3)
    for kind in (1, 2, 3):
        pull_control(bytes([kind]) + data)
