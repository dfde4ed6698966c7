"""What a service does now and then: by a rate, by what has lasted, with what it knows of the link's delay."""

from __future__ import annotations

import math

import pytest

from skytether.service import Lasting, MeanDelay, Rate, RawReceived


def arrived(sent_at: float, received_at: float, error: float = 0.0) -> RawReceived:
    return RawReceived(0, sent_at, error, received_at, "topic", "type", "cdr", b"")


def test_of_what_is_late_one_at_the_most_is_made_up_for() -> None:
    rate = Rate(10.0)
    assert [rate.due(now) for now in (5.0, 5.05, 5.1, 5.75, 5.75, 5.75)] == [True, False, True, True, True, False]
    assert not Rate(0.0).due(5.0)


def test_a_state_is_told_once_when_it_has_lasted() -> None:
    lasting = Lasting("first")
    assert not lasting.due("first", 100.0, 1.0), "nothing is said of the first one"
    assert [lasting.due("new", 100.0 + t, 1.0) for t in (0.0, 0.9, 1.0, 9.0)] == [False, False, True, False]
    assert not lasting.due("other", 110.0, 1.0)
    assert not lasting.due("new", 110.5, 1.0), "it begins anew"
    assert lasting.due("end", 110.6, 0.0), "at once"


def test_the_delay_is_a_mean_that_other_clocks_do_not_touch() -> None:
    delay = MeanDelay()
    for _ in range(100):
        delay.note(arrived(10.0, 10.2))
    assert delay.seconds == pytest.approx(0.2, abs=1e-4)
    for odd in (arrived(10.0, 10.5, math.inf), arrived(10.0, 25.0), arrived(10.0, 9.0)):
        delay.note(odd)
    assert delay.seconds == pytest.approx(0.2, abs=1e-4)


def test_nothing_was_made_later_than_it_came() -> None:
    assert arrived(10.0, 10.2).made_at == 10.0
    assert arrived(3600.0, 10.2).made_at == 10.2
    assert arrived(10.0, 10.2, math.inf).made_at == 10.2
