import logging

from skytether.robot.log_throttle import LogThrottle

LOG = logging.getLogger("test")


def test_a_trouble_is_named_once_while_it_lasts_and_again_when_it_comes_back(caplog):
    notices = LogThrottle(LOG, quiet_s=30.0)
    for i in range(10_000):
        notices.warn("nan", "a NaN", i / 100)
    notices.warn("inf", "an infinity", 50.0)
    assert caplog.messages == ["a NaN", "an infinity"]
    notices.warn("nan", "a NaN", 200.0)
    assert caplog.messages == ["a NaN", "an infinity", "a NaN"]


def test_a_clock_that_jumps_back_is_no_news(caplog):
    notices = LogThrottle(LOG)
    for now in (100.0, 3.0, 3.01, 3.02):
        notices.warn("nan", "a NaN", now)
    assert caplog.messages == ["a NaN"]


def test_kinds_are_bounded(caplog):
    notices = LogThrottle(LOG)
    for i in range(1000):
        notices.warn(str(i), "one more", 1.0)
    assert len(caplog.messages) == 64
