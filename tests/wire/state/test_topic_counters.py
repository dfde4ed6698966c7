"""Counters by topic at two ends that report to each other, over epochs and restarts."""

import math

import pytest

from skytether.wire import Direction, Role, Topic
from skytether.wire.codec.ciphers import Ciphers
from skytether.wire.codec.frames import ReceiverRow, Report, SenderRow
from skytether.wire.state.epoch import Epoch
from skytether.wire.state.topic_counters import ROWS_PER_REPORT, TopicCounters

CIPHERS = Ciphers(bytes(32), bytes(32), bytes(8), 1)
SCAN = Topic("scan", "a/msg/B", Direction.IN, priority=100, lifespan=0.2)
LOG = Topic("log", "a/msg/B", Direction.IN, priority=50, lifespan=1.0, depth=10, reliable=True)
CMD = Topic("cmd_vel", "a/msg/B", Direction.OUT, priority=127, lifespan=0.1)
TABLE = (SCAN, LOG, CMD)
NAN = math.nan


class End:
    """One end's counters, with the topics of an epoch."""

    def __init__(self, role, table=TABLE, life=b"first"):
        self.counters = TopicCounters(role)
        self.begin(table, life)

    def begin(self, table=TABLE, life=b"first"):
        send, receive = self.counters.topics(enumerate(table, 1))
        self.epoch = Epoch(1, CIPHERS, table, send, receive, life)
        self.counters.start_epoch(self.epoch)

    def row(self, topic):
        (row,) = self.counters.stats({topic.name: topic})
        return row

    def report(self, now=1.0):
        senders, receivers = self.counters.rows(self.epoch, now)
        return Report(tuple(senders), tuple(receivers))

    def hear(self, report, now=1.0):
        self.counters.apply_report(report, self.epoch, now)


@pytest.fixture
def robot():
    return End(Role.ROBOT)


@pytest.fixture
def service():
    return End(Role.SERVICE)


def send(end, topic, count, size=100):
    sent = end.epoch.send[topic.name]
    out = end.counters.outbound(topic.name)
    out.offered += count
    out.sent += count
    out.bytes_sent += (size + 60) * count
    out.payload_sent += size * count
    sent.sequence += count


def arrive(end, topic, sequences, now=1.0):
    received = next(t for t in end.epoch.receive.values() if t.name == topic.name)
    for sequence in sequences:
        received.arrived(sequence, 100, 0.02, 0.001, False, now)


def test_each_end_sends_the_topics_of_its_direction(robot, service):
    assert set(robot.epoch.send) == {"scan", "log"} == {t.name for t in service.epoch.receive.values()}
    assert set(service.epoch.send) == {"cmd_vel"} == {t.name for t in robot.epoch.receive.values()}


def test_both_ends_know_both_directions_once_they_have_reported(robot, service):
    send(robot, SCAN, 10)
    arrive(service, SCAN, [0, 1, 2, 3, 4, 5, 8, 9])
    assert robot.row(SCAN).delivered == 0
    service.hear(robot.report())
    robot.hear(service.report(now=5.0), now=5.0)
    for end in (robot, service):
        row = end.row(SCAN)
        assert (row.offered, row.sent, row.delivered, row.lost, row.unsettled) == (10, 10, 8, 2, 0)
        assert row.delay_p50 == pytest.approx(0.02, rel=0.1)
    assert robot.row(SCAN).bytes_delivered == 800
    assert (robot.row(SCAN).direction, robot.row(SCAN).priority) == ("in", 100)


def test_what_arrived_was_sent_though_nobody_has_said_so(service):
    arrive(service, SCAN, range(5))
    row = service.row(SCAN)
    assert (row.offered, row.sent, row.delivered) == (5, 5, 5)


def test_what_was_refused_is_counted_at_the_sender_alone(robot, service):
    robot.counters.refuse("scan")
    robot.counters.refuse("scan")
    assert (robot.row(SCAN).refused, robot.row(SCAN).published, robot.row(SCAN).offered) == (2, 2, 0)
    service.hear(robot.report())
    assert service.row(SCAN).refused == 0


def test_of_reports_that_overtook_each_other_the_newest_stays(robot, service):
    send(robot, SCAN, 10)
    arrive(service, SCAN, range(4))
    early = service.report(now=1.0)
    arrive(service, SCAN, range(4, 10))
    late = service.report(now=1.1)
    robot.hear(late)
    robot.hear(early)
    assert robot.row(SCAN).delivered == 10
    first = robot.report()
    send(robot, SCAN, 7)
    service.hear(robot.report())
    service.hear(first)
    assert service.row(SCAN).sent == 17


def test_a_loss_that_came_late_after_all_is_no_step_back(robot):
    nothing = (*[0] * 4, *[NAN] * 8)
    send(robot, SCAN, 10)
    for delivered, lost, late in ((8, 2, 0), (9, 1, 1)):
        robot.hear(Report((), (ReceiverRow(1, delivered, lost, late, *nothing),)))
    row = robot.row(SCAN)
    assert (row.delivered, row.lost, row.late) == (9, 1, 1)


def test_rows_of_unknown_topics_are_nothing(robot):
    robot.hear(Report((SenderRow(77, 1, 1, 1, 0, 0, 0, 1),), (ReceiverRow(78, 1, *[0] * 6, *[NAN] * 8),)))
    assert [robot.row(topic).sent for topic in TABLE] == [0, 0, 0]


def test_no_counter_goes_down_when_the_peer_is_restarted_and_the_books_balance(robot, service):
    send(robot, SCAN, 10)
    send(robot, LOG, 10)
    arrive(service, SCAN, range(6))
    robot.hear(service.report())
    before = robot.row(SCAN)
    robot.begin(life=b"second")
    after = robot.row(SCAN)
    assert (after.sent, after.delivered) == (before.sent, before.delivered) == (10, 6)
    assert after.unknown == 4
    assert after.sent == after.delivered + after.superseded + after.lost + after.unknown
    assert robot.row(LOG).unknown == 0, "what is not acknowledged of a reliable topic is sent again"
    again = End(Role.SERVICE, life=b"robot")
    send(robot, SCAN, 5)
    arrive(again, SCAN, range(5))
    robot.hear(again.report())
    assert (robot.row(SCAN).sent, robot.row(SCAN).delivered, robot.row(SCAN).unknown) == (15, 11, 4)


def test_new_keys_of_the_same_peer_keep_everything(robot, service):
    send(service, CMD, 3)
    robot.hear(service.report())
    robot.begin(life=b"first")
    assert (robot.row(CMD).offered, robot.row(CMD).unknown) == (3, 0)


def test_what_a_restarted_peer_said_before_is_not_taken_for_the_new_one(robot, service):
    send(service, CMD, 3)
    late = service.report()
    epoch = robot.epoch
    robot.begin(life=b"second")
    robot.counters.apply_report(late, epoch, 1.0)
    assert robot.row(CMD).offered == 0


def test_topics_that_the_next_peer_does_not_have_are_forgotten(robot):
    send(robot, SCAN, 10)
    robot.begin(table=(CMD,), life=b"second")
    robot.begin(life=b"third")
    assert robot.row(SCAN).sent == 0


def test_the_overhead_is_of_what_was_published(robot):
    assert all(math.isnan(share) for share in robot.counters.overhead())
    send(robot, SCAN, 10, size=100)
    robot.counters.outbound("scan").bytes_redundant = 320
    assert robot.counters.overhead() == pytest.approx((0.6, 0.32))


def test_rows_of_a_large_table_take_turns():
    table = tuple(Topic(f"t{i}", "a/msg/B", Direction.IN) for i in range(ROWS_PER_REPORT + 50))
    robot = End(Role.ROBOT, table)
    turns = [[row.topic for row in robot.report().senders] for _ in range(4)]
    assert all(len(rows) == ROWS_PER_REPORT == len(set(rows)) for rows in turns)
    assert set().union(*turns) == set(range(1, len(table) + 1))
