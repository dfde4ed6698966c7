from dataclasses import replace
from math import inf, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.api.manifest import Needs, TopicSpec
from skytether.robot.control.arbiter import LinkRequirements, LinkState, Reason
from skytether.robot.control.service_manager import ServiceManager, Terms, explain, terms, tighten
from skytether.robot.session.link_quality import LinkMonitor, Quality
from skytether.wire.stats import SessionStats, TopicStats

CMD_VEL = TopicSpec(name="cmd_vel", type="geometry_msgs/msg/Twist", direction="out", period_ms=50)


def test_terms_are_read_from_the_manifest():
    asked = Needs(max_rtt_ms=100, max_loss=0.05)
    assert terms(asked, [CMD_VEL], "cmd_vel") == Terms(0.1, 0.05, 0.05, 0.05)
    assert terms(Needs(), [CMD_VEL], "other") == Terms(None, None, 0.5, None)


def stats(delivered: int, offered: int = 0, expired: int = 0) -> SessionStats:
    topic = TopicStats("cmd_vel", "out", 127, delivered=delivered)
    return SessionStats(True, (topic, TopicStats("scan", "in", 1, offered=offered, expired=expired)))


def test_lateness_is_what_missed_its_lifespan_within_the_window():
    monitor = LinkMonitor(window_s=2.0, least=20)
    monitor.sample(stats(0, 100, 100), 0.0)
    assert monitor.sample(stats(0, 200, 130), 1.0)[2:] == (pytest.approx(0.3), "", "scan")
    assert monitor.sample(stats(0, 200, 130), 4.0).late is not None


def test_a_service_that_sends_at_ten_times_its_rate_is_told():
    manager = ServiceManager(Terms(period_s=0.05), "cmd_vel", 0.15)
    for i in range(21):
        manager.watch(stats(2 * i), i / 10)
    assert manager.troubles() == []
    for i in range(21):
        manager.watch(stats(42 + 20 * i), 2 + i / 10)
    ((kind, sentence),) = manager.troubles()
    assert kind == "overrate"
    assert "sends cmd_vel 200 times a second, its manifest says 20" in sentence


def test_a_service_too_slow_for_the_robots_limits_is_told():
    ((kind, sentence),) = ServiceManager(Terms(period_s=0.2), "cmd_vel", 0.15).troubles()
    assert kind == "slow"
    assert "raise limits.max_gap_s to 0.5 or more" in sentence


@pytest.mark.parametrize("reason", list(Reason))
def test_every_hand_over_is_explained_whatever_is_unknown(reason):
    for link in (LinkState(), LinkState(True, 1.0, nan, nan, nan, nan), LinkState(True, 5.0, 0.3, 0.2, 0.1, inf)):
        for needs in (LinkRequirements(), replace(LinkRequirements(), max_rtt_s=0.1, max_loss=0.1)):
            sentence = explain(reason, needs, link, Quality(), 5.2)
            assert sentence
            assert "\n" not in sentence


NUMBER = st.one_of(st.none(), st.floats(0, 1e308), st.sampled_from([inf, nan, 0.0, 5e-324]))


@given(rtt=NUMBER, loss=NUMBER, late=st.floats(0, 1e308), period=NUMBER)
def test_no_answer_widens_what_the_robot_needs(rtt, loss, late, period):
    own = LinkRequirements(max_rtt_s=0.4, max_loss=0.3, max_late=0.2)
    needs = tighten(own, Terms(rtt, loss, late, period))
    assert needs.max_rtt_s is not None
    assert needs.max_rtt_s <= 0.4
    assert needs.max_loss is not None
    assert needs.max_loss <= 0.3
    assert needs.max_late <= 0.2
    same = ("max_clock_error_s", "command_timeout_s", "bad_s", "good_s", "local")
    assert all(getattr(needs, name) == getattr(own, name) for name in same)


def test_a_stricter_service_is_held_to_its_own_needs():
    assert tighten(LinkRequirements(), Terms(0.1, 0.05, 0.05)) == LinkRequirements(
        max_rtt_s=0.1, max_loss=0.05, max_late=0.05
    )
