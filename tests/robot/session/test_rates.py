"""Messages a second, from counters."""

import pytest

from skytether.robot.session.rates import Rates
from skytether.wire.stats import SessionStats, TopicStats


def sample(rates, now, scans, commands=0, refused=0):
    topics = (
        TopicStats("scan", "in", 0, refused=refused, offered=scans),
        TopicStats("cmd_vel", "out", 0, sent=9_999, delivered=commands),
    )
    rates.sample(SessionStats(True, topics), now)


def test_a_rate_is_over_the_last_two_seconds():
    rates = Rates()
    for tick in range(51):  # 40 Hz for three seconds, then nothing
        sample(rates, tick / 10, min(4 * tick, 120), tick)
        if tick == 30:
            assert rates.now[("scan", "in")] == pytest.approx(40.0)
    assert rates.now[("scan", "in")] == 0.0
    assert rates.now[("cmd_vel", "out")] == pytest.approx(10.0)


def test_what_is_refused_was_published_all_the_same():
    rates = Rates()
    sample(rates, 0.0, 100, refused=0)
    sample(rates, 1.0, 100, refused=30)
    assert rates.now[("scan", "in")] == pytest.approx(30.0)


def test_another_session_that_counts_from_zero_gives_no_negative_rate():
    rates = Rates()
    sample(rates, 0.0, 1000)
    sample(rates, 1.0, 1040)
    sample(rates, 2.0, 0)
    sample(rates, 3.0, 40)
    assert rates.now[("scan", "in")] == pytest.approx(40.0)
