from dataclasses import replace

from skytether.api.rest import MOST_COUNTED, MOST_TOPICS
from skytether.robot.agent.snapshot import report
from skytether.robot.session.counter_totals import CounterTotals
from skytether.wire.stats import SessionStats, TopicStats

SCAN = TopicStats("scan", "in", 100, offered=12, sent=10, delivered=7, lost=2, late=1, bytes_sent=900)


class Session:
    """What stands for one."""


def of(*topics: TopicStats) -> SessionStats:
    return SessionStats(True, topics)


def counted(totals: CounterTotals, topic: str = "scan") -> tuple[int, int, int, int]:
    _, counts = totals.sums()[topic, "in"]
    return counts["sent"], counts["delivered"], counts["lost"], counts["late"]


def test_sessions_add_up_also_while_there_are_two():
    totals, first, second = CounterTotals("a"), Session(), Session()
    totals.update(first, of(SCAN))
    totals.update(second, of(SCAN))
    assert counted(totals) == (20, 14, 6, 2)
    totals.update(first, of(replace(SCAN, sent=11, delivered=8)), last=True)
    assert counted(totals) == (21, 15, 6, 2)
    totals.update(first, of(SCAN))  # somebody who looked at the same time
    assert counted(totals) == (21, 15, 6, 2)
    totals.update(second, of(replace(SCAN, sent=15, delivered=12)), last=True)
    assert counted(totals) == (26, 20, 6, 2)


def test_nothing_goes_down():
    totals, session = CounterTotals("a"), Session()
    totals.update(session, of(SCAN))
    totals.update(session, of(replace(SCAN, lost=1, late=2, delivered=8)))  # a loss was late after all
    assert counted(totals) == (10, 8, 3, 2)
    totals.update(session, of(SCAN))  # an older look
    totals.update(session, of())  # the topic is gone
    assert counted(totals) == (10, 8, 3, 2)
    totals.update(session, of(), last=True)
    assert counted(totals) == (10, 8, 3, 2)


def test_what_is_under_way_when_a_session_ends_is_unknown():
    totals, session = CounterTotals("a"), Session()
    totals.update(session, of(replace(SCAN, sent=15)))
    assert totals.sums()["scan", "in"][1]["unknown"] == 0
    totals.update(session, of(replace(SCAN, sent=15)), last=True)
    assert totals.sums()["scan", "in"][1]["unknown"] == 6  # of 15, 7 arrived and 2 are lost


def test_a_report_has_the_sums_of_all_sessions_and_the_delays_of_the_present_one():
    totals = CounterTotals("a")
    totals.update(Session(), of(SCAN, TopicStats("old", "in", 5, sent=3)), last=True)
    now = of(replace(SCAN, sent=2**60, delay_p50=0.02))
    totals.update(Session(), now)
    told = report(None, totals, now, 0.1)
    scan, old = told.topics
    assert (told.life, scan.topic, scan.sent, scan.delivered, scan.delay_p50_s) == ("a", "scan", MOST_COUNTED, 14, 0.02)
    assert (old.topic, old.sent, old.delay_p50_s) == ("old", 3, None)


def test_a_report_of_more_topics_than_it_may_have_names_those_of_the_present_session():
    totals, now = CounterTotals("a"), of(SCAN)
    totals.update(Session(), of(*(TopicStats(str(n), "in", 5) for n in range(MOST_TOPICS))), last=True)
    totals.update(Session(), now)
    told = report(None, totals, now, 0.1).topics
    assert (len(told), told[0].topic) == (MOST_TOPICS, "scan")
