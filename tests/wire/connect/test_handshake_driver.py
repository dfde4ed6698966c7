"""The conversation around a handshake: what is answered, to whom, how often, and what is told of it."""

import pytest
from link_look import events, rejected, welcomes

from skytether.emulator.link_model import LinkConditions
from skytether.wire import Config, Connected, Direction, Refused, Role, Topic
from skytether.wire.codec import packet
from skytether.wire.codec.negotiation import TablesDifferError
from skytether.wire.connect import handshake
from skytether.wire.connect.handshake_driver import MAX_RAW

ROBOT, SERVICE = Role.ROBOT, Role.SERVICE
IN = Direction.IN


def test_nobody_answers_what_is_not_for_him(world):
    """A robot is asked, and a service or a robot that asked nothing is answered."""
    link = world.link(record=True)
    (hello,) = (p for _, p in link.sent[ROBOT] if p[0] == packet.HELLO)
    (welcome,) = welcomes(link)
    sent = {role: len(link.sent[role]) for role in Role}
    link.inject(ROBOT, hello)
    link.inject(ROBOT, welcome)
    link.inject(SERVICE, welcome)
    assert rejected(link, ROBOT) == {"unasked": 2}
    assert rejected(link, SERVICE) == {"unasked": 1}
    assert {role: len(link.sent[role]) for role in Role} == sent
    assert all(len(link.events[role]) == 1 for role in Role)


def test_questions_repeated_faster_than_answers_leave_are_not_all_answered(world):
    """Answers wait for the socket; a flood of questions makes no heap of them."""
    asking = world.link(connect=False, up=LinkConditions(cut=True), record=True)
    asking.run(0.01)
    hello = asking.sent[ROBOT][0][1]
    service = world.session(SERVICE)
    for _ in range(10 * MAX_RAW):
        service.receive(hello, "robot", 0.02)
    answers = [b for batches in iter(lambda: service.transmit(0.02), []) for b in batches]
    assert 0 < len(answers) <= MAX_RAW
    service.receive(hello, "robot", 0.5)
    assert service.transmit(0.5), "and later questions are answered again"


def test_a_robot_that_still_holds_the_keys_is_told_so_where_it_asks(world):
    """It was silent for long, and is elsewhere now: no new handshake."""
    link = world.link(record=True)
    for model in link.models.values():
        model.conditions = LinkConditions(cut=True)
    link.run(3.0)
    link.addresses[ROBOT] = "moved"
    for model in link.models.values():
        model.conditions = LinkConditions(delay=0.01)
    link.run(3.0)
    assert link.sessions[SERVICE].stats(link.now).connected
    assert link.sessions[SERVICE].stats(link.now).handshakes == 1
    assert link.sessions[SERVICE].stats(link.now).paths[0].address == "moved"
    assert len(welcomes(link)) == 1


def test_a_lost_answer_is_repeated_the_same(world):
    link = world.link(connect=False, down=LinkConditions(cut=True), record=True)
    link.run(0.5)
    assert len(welcomes(link)) > 1
    assert len(set(welcomes(link))) == 1
    link.models[SERVICE].conditions = LinkConditions()
    link.run(2.0)
    assert link.sessions[SERVICE].stats(0).handshakes == 1
    assert events(link, ROBOT, Connected)


def test_tables_that_differ_are_told_to_both_ends_once(world):
    robot = {"topics": [Topic("scan", "sensor_msgs/msg/LaserScan", IN)]}
    service = {"topics": [Topic("scan", "sensor_msgs/msg/PointCloud2", IN)]}
    link = world.link(connect=False, robot=robot, service=service)
    link.run(5.0)
    for role in Role:
        [(_, refused)] = link.events[role]
        assert isinstance(refused, Refused)
        assert all(word in refused.reason for word in ("scan", "LaserScan", "PointCloud2"))
    # Once the service is replaced by one that fits, all is well.
    link.replace(SERVICE, world.session(SERVICE, topics=robot["topics"]))
    link.run(2.0)
    assert events(link, ROBOT, Connected)


def test_a_false_welcome_is_ignored(world):
    link = world.link(connect=False, record=True, down=LinkConditions(delay=0.03))
    link.run(0.02)
    welcome = welcomes(link)[0]
    link.inject(ROBOT, welcome[:-1] + bytes([welcome[-1] ^ 1]))
    assert rejected(link, ROBOT) == {"welcome_forged": 1}
    link.run(1.0)
    assert len(events(link, ROBOT, Connected)) == 1


@pytest.mark.parametrize("loss", [0.05, 0.3, 0.89])
def test_an_answer_is_at_most_three_times_as_long_however_much_is_lost(world, loss):
    """Its parity is planned by what the peer, or whoever drops packets, makes this end believe."""
    share = world.random.random
    fields = "period", "lifespan", "delivery"
    table = [Topic(f"topic{i}", "a/msg/B", IN, **{name: share() for name in fields}) for i in range(12)]
    service = {"topics": table, "config": Config(assumed_loss=loss)}
    link = world.link(connect=False, record=True, robot={"topics": table}, service=service)
    link.run(0.03)
    asked = sum(len(p) for _, p in link.sent[ROBOT] if p[0] == packet.HELLO)
    answered = [len(p) for _, p in link.sent[SERVICE] if p[0] == packet.WELCOME]
    assert len(answered) >= 2
    assert sum(answered) <= 3 * asked
    link.run(0.5)
    assert link.sessions[SERVICE].stats(link.now).connected


def test_why_a_peer_refuses_is_one_short_line(world, monkeypatch):
    def refuse(*_):
        raise TablesDifferError("\x1b[2Jgone\n" + "x" * 1000)

    monkeypatch.setattr(handshake, "negotiate", refuse)
    monkeypatch.setattr(handshake, "MAX_REASON", 1000)  # of the service, which tells all of it
    link = world.link(connect=False)
    link.run(1.0)
    ((_, refused),) = events(link, ROBOT, Refused)
    assert refused.reason == "?[2Jgone?" + "x" * 291
