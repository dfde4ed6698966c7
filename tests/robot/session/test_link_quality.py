from math import isnan, nan

import pytest

from skytether.robot.session.link_quality import LinkMonitor
from skytether.wire.stats import PathStats, SessionStats, TopicStats


def stats(delivered: int, lost: int, superseded: int = 0, rtts: tuple[float, ...] = (0.1,)) -> SessionStats:
    topics = (
        TopicStats("a", "in", 1, delivered=delivered, lost=lost, superseded=superseded),
        TopicStats("quiet", "out", 1, delivered=0, lost=5),
    )
    return SessionStats(True, topics, tuple(PathStats(i, None, rtt=rtt) for i, rtt in enumerate(rtts)))


def test_loss_is_of_the_window_not_of_the_whole_run():
    monitor = LinkMonitor(window_s=2.0, least=20)
    assert isnan(monitor.sample(stats(0, 0), 0.0)[1])
    assert monitor.sample(stats(90, 10), 1.0)[1] == pytest.approx(0.1)
    assert monitor.sample(stats(190, 10), 2.0)[1] == pytest.approx(0.05)
    assert monitor.sample(stats(290, 10), 3.0)[1] == 0.0
    assert monitor.sample(stats(290, 10), 4.0)[1] == 0.0
    assert isnan(monitor.sample(stats(290, 10), 6.0)[1]), "nothing was sent"


def test_superseded_messages_arrived_and_late_ones_take_a_loss_back():
    monitor = LinkMonitor()
    monitor.sample(stats(0, 20), 0.0)
    assert monitor.sample(stats(50, 10, superseded=50), 0.1)[1] == 0.0


def one_way(sent: int, delivered: int, direction: str = "in") -> SessionStats:
    return SessionStats(True, (TopicStats("a", direction, 1, sent=sent, delivered=delivered),))


def test_when_only_the_way_to_the_service_is_broken_everything_is_lost():
    monitor = LinkMonitor(window_s=2.0)
    for i in range(10):  # 1 s with reports: what was delivered lags behind
        assert not monitor.sample(one_way(10 * i, 10 * (i - 5) if i > 5 else 0), i / 10)[1] > 0
    losses = [monitor.sample(one_way(10 * i, 40), i / 10)[1] for i in range(10, 40)]
    assert not any(loss > 0 for loss in losses[:18]), "the window still holds arrivals"
    assert losses[-1] == 1.0
    assert monitor.sample(one_way(400, 200), 4.0)[1] == 0.0


def test_silence_of_what_is_not_sent_or_sent_by_the_service_is_no_loss():
    idle, out = LinkMonitor(), LinkMonitor()
    for i in range(40):
        assert isnan(idle.sample(one_way(5, 5), i / 10)[1])
        assert isnan(out.sample(one_way(10 * i, 0, "out"), i / 10)[1])


def test_the_best_path_counts():
    assert LinkMonitor().sample(stats(0, 0, rtts=(0.3, nan, 0.2)), 0.0)[0] == 0.2
    assert isnan(LinkMonitor().sample(stats(0, 0, rtts=()), 0.0)[0])
