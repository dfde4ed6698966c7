"""Snapshots of what an end knows: the books of one topic add up as their documentation says."""

import math

from hypothesis import given
from hypothesis import strategies as st

from skytether.wire import PathStats, SessionStats, TopicStats

COUNTS = st.integers(0, 2**40)


@given(COUNTS, COUNTS, COUNTS, COUNTS, COUNTS, COUNTS)
def test_whatever_was_published_is_somewhere(refused, dropped, delivered, superseded, lost, under_way):
    sent = delivered + superseded + lost + under_way
    row = TopicStats(
        "scan",
        "in",
        100,
        refused=refused,
        offered=sent + dropped,
        sent=sent,
        delivered=delivered,
        superseded=superseded,
        lost=lost,
    )
    assert row.published == row.refused + row.offered
    assert row.offered == row.sent + row.dropped
    assert row.sent == row.delivered + row.superseded + row.lost + row.unsettled
    assert (row.dropped, row.unsettled) == (dropped, under_way)


def test_reports_that_overtake_each_other_make_no_number_negative():
    """One end's counters are exact, the other's as of its last report."""
    row = TopicStats("scan", "in", 100, offered=3, sent=5, delivered=4, superseded=1, lost=2)
    assert (row.dropped, row.unsettled) == (0, 0)


def test_what_was_not_measured_yet_is_no_number():
    topic, path, session = TopicStats("scan", "in", 100), PathStats(0, None), SessionStats(False)
    assert all(math.isnan(value) for value in (topic.delay_p50, topic.jitter, topic.period_p99))
    assert all(math.isnan(value) for value in (path.rtt, path.loss_in, path.loss_out, path.rate, path.overhead))
    assert math.isnan(session.clock_offset)
    assert session.clock_error == math.inf
    assert topic.published == topic.unsettled == 0
