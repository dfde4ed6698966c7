"""Addresses that have to be proven: who overhears a session and is fast gets little of it, and turns it nowhere."""

from functools import partial

import pytest

from skytether.emulator.link_model import LinkConditions
from skytether.wire import Direction, PathUse, PeerMoved, Role, Topic
from skytether.wire.codec import packet
from skytether.wire.path.path_validation import AMPLIFICATION_LIMIT, MAX_CANDIDATES, SPACING, PathValidation

ROBOT, SERVICE = Role.ROBOT, Role.SERVICE
SLOW = LinkConditions(delay=0.05)
TOPICS = (
    Topic("up", "t/msg/T", Direction.IN, priority=100, lifespan=0.5, depth=10, paths=PathUse.REDUNDANT),
    Topic("down", "t/msg/T", Direction.OUT, priority=100, lifespan=0.5, depth=10, paths=PathUse.REDUNDANT),
    Topic("image", "t/msg/T", Direction.OUT, priority=10, lifespan=0.5, depth=10),
)


def test_an_address_is_sent_three_times_what_came_from_it_at_most():
    validation = PathValidation()
    assert list(validation.allowances(100, None)) == []
    assert validation.packet_came("new", 100, 0.0, 1.0)
    assert list(validation.allowances(200, None)) == [("new", 200)]
    assert list(validation.allowances(101, None)) == []
    validation.sent("new", 90)
    assert list(validation.allowances(500, 6)) == [("new", 6)]  # whole datagrams
    assert list(validation.allowances(500, 6)) == []
    validation.packet_came("new", 10, 0.0, 1.0)
    assert list(validation.allowances(34, 17)) == [("new", 34)]
    validation.sent("new", 1000)
    assert list(validation.allowances(1, 1)) == []


def test_challenges_are_spaced_and_each_is_of_one_address():
    validation = PathValidation()
    for challenge, address in ((7, "a"), (8, "b")):
        assert validation.packet_came(address, 1, 0.0, 5.0)
        validation.challenge(address, challenge, 5.0)
        assert not validation.packet_came(address, 1, 0.0, 5.0 + 0.9 * SPACING)
        assert validation.packet_came(address, 1, 0.0, 5.0 + SPACING)
    assert validation.answered(0) is None
    assert validation.answered(8) == ("b", 0.0)
    assert len(validation) == 0
    assert validation.answered(7) is None


def test_candidates_are_bounded():
    validation = PathValidation()
    for i in range(100):
        validation.packet_came(i, 10, 0.0, 0.0)
        validation.challenge(i, i + 1, 0.0)
    assert len(validation) == MAX_CANDIDATES
    assert [address for address, _ in validation.allowances(1, None)] == [96, 97, 98, 99]


@pytest.fixture
def link(world):
    """Two ends 50 ms apart, with traffic both ways at 100 Hz for 2 s from now on."""
    ends = {"topics": TOPICS}
    link = world.link(robot=ends, service=ends, up=SLOW, down=SLOW, record=True)
    link.run(0.5)
    for role, topic in ((ROBOT, "up"), (SERVICE, "down")):
        numbers = iter(range(1000))
        link.every(0.01, link.now + 2.0, partial(publish_next, link, role, topic, numbers))
    return link


def publish_next(link, role, topic, numbers):
    link.publish(role, topic, bytes([next(numbers)] * 100))


def lost(link, role):
    """Numbers of 200 that did not arrive at one end."""
    return set(range(200)) - {m.payload[0] for _, m in link.messages[role]}


def moves(link, role):
    return [e.address for _, e in link.events[role] if isinstance(e, PeerMoved)]


@pytest.mark.parametrize("role", Role)
def test_who_repeats_from_elsewhere_what_he_overhears_turns_nothing(link, role):
    """Each packet reaches one end first from an address that never answers: by a spoofed one, say."""
    other = SERVICE if role is ROBOT else ROBOT
    heard, told, seen = 0, 0, len(link.sent[role])
    sessions = link.sessions
    transmit = sessions[other].transmit

    def watch(now, full=()):
        nonlocal told
        sent = transmit(now, full)
        told += sum(len(one.data) for one in sent if one.address == "victim")
        return sent

    sessions[other].transmit = watch
    for _ in range(400):
        link.run(0.005)
        for _, one in link.sent[role][seen:]:
            link.inject(other, one, "victim")
            heard += len(one)
        seen = len(link.sent[role])
    link.run(0.5)
    assert moves(link, ROBOT) == moves(link, SERVICE) == []
    assert 0 < told <= AMPLIFICATION_LIMIT * heard
    assert lost(link, ROBOT) == lost(link, SERVICE) == set()
    assert {p.handshakes for p in (s.stats(link.now) for s in sessions.values())} == {1}


@pytest.mark.parametrize("role", Role)
def test_an_end_that_moved_is_followed_once_it_has_answered(link, role):
    """Nothing is lost of a redundant topic, on one path too, and the first message is there in a round trip."""
    link.run(1.0)
    other = SERVICE if role is ROBOT else ROBOT
    moved_at, before = link.now, len(link.messages[role])
    link.addresses[role] = "elsewhere"
    link.run(0.045)  # what was on its way to the old place is lost there
    before = len(link.messages[role])
    link.run(2.0)
    assert moves(link, other) == ["elsewhere"]
    assert moves(link, role) == []
    told_at = next(t for t, e in link.events[other] if isinstance(e, PeerMoved))
    assert told_at - moved_at <= 3 * 0.05 + 0.03  # heard, asked, answered
    assert lost(link, ROBOT) == lost(link, SERVICE) == set()
    assert next(t for t, _ in link.messages[role][before:]) - moved_at <= 0.1 + 0.011


def test_large_messages_go_to_a_proven_address_only(link):
    link.run(1.0)
    link.addresses[ROBOT] = "elsewhere"
    link.every(0.02, link.now + 1.0, lambda: link.publish(SERVICE, "image", bytes(20_000)))
    link.run(0.14)
    assert moves(link, SERVICE) == []
    link.run(1.0)
    assert moves(link, SERVICE) == ["elsewhere"]
    assert len([m for _, m in link.messages[ROBOT] if m.topic == "image"]) >= 40


@pytest.mark.slow
def test_a_move_under_loss_takes_a_few_questions(make_world):
    for seed in range(8):
        bad = [LinkConditions(delay=0.02, loss=0.3, seed=2 * seed + i) for i in range(2)]
        link = make_world(seed).link(connect=False, up=bad[0], down=bad[1])
        link.run(3.0)
        link.addresses[ROBOT] = "elsewhere"
        link.run(2.0)
        assert moves(link, SERVICE) == ["elsewhere"]


def test_a_robot_is_where_it_asked_from_without_further_questions(world):
    link = world.link(up=SLOW, down=SLOW, record=True)
    link.run(1.0)
    link.addresses[ROBOT] = "elsewhere"
    link.replace(ROBOT, world.session(ROBOT, now=link.now))
    began = link.now
    link.run(1.0)
    assert [t - began for t, e in link.events[SERVICE] if e == PeerMoved("elsewhere")] == [pytest.approx(0.15)]


def test_whose_question_was_repeated_by_somebody_else_is_asked_where_it_is(world):
    link = world.link(connect=False, up=SLOW, down=SLOW, record=True)
    link.run(0.04)
    link.inject(SERVICE, link.sent[ROBOT][0][1], "thief")
    link.run(0.066)
    confirmed = next(p for _, p in link.sent[ROBOT] if p[0] == packet.DATA)
    link.inject(SERVICE, confirmed, "thief")
    assert link.sessions[SERVICE].stats(link.now).paths[0].address is None
    link.run(0.5)
    assert link.sessions[SERVICE].stats(link.now).paths[0].address == "robot"
    link.publish(SERVICE, "map", bytes(5000))
    link.run(0.1)
    assert len(link.messages[ROBOT]) == 1
