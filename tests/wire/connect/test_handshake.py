"""Handshake: who gets in, who gets no answer, and what neither disturbs."""

import pytest
from deep_size import deep_size
from link_look import events, hellos, rejected, welcomes

from skytether.emulator.link_model import LinkConditions
from skytether.wire import Config, Connected, Direction, Role, Session, Topic
from skytether.wire.codec import packet
from skytether.wire.connect.handshake import NO_KEYS, HandshakeResponder, Hello

ROBOT, SERVICE = Role.ROBOT, Role.SERVICE
IN = Direction.IN


def test_one_round_trip(world, topics):
    delay = LinkConditions(delay=0.02)
    link = world.link(up=delay, down=delay, record=True)
    assert [t for t, _ in events(link, ROBOT, Connected)] == [pytest.approx(0.04)]
    assert [t for t, _ in events(link, SERVICE, Connected)] == [pytest.approx(0.06)]
    assert link.events[ROBOT][0][1].topics == link.events[SERVICE][0][1].topics == topics
    assert len(hellos(link)) == len(welcomes(link)) == 1


@pytest.mark.parametrize(
    ("robot", "reason"), [({"key": bytes(32)}, "hello_forged"), ({"session_id": 7}, "session")], ids=["key", "id"]
)
def test_who_does_not_belong_gets_no_answer(world, robot, reason):
    link = world.link(connect=False, robot=robot, record=True)
    link.run(3.0)
    assert link.sent[SERVICE] == []
    assert rejected(link, SERVICE)[reason] >= 4
    assert not link.events[SERVICE]


def test_another_version_gets_no_answer(world):
    link = world.link(connect=False, record=True, up=LinkConditions(cut=True))
    link.run(0.01)
    hello = bytearray(hellos(link)[0])
    hello[0] = (packet.VERSION - 1) << 4 | 1
    link.inject(SERVICE, bytes(hello))
    assert rejected(link, SERVICE) == {"version": 1}
    assert link.sent[SERVICE] == []


def test_a_table_of_many_packets_travels_over_a_bad_link(world):
    table = [Topic(world.random.randbytes(20).hex(), world.random.randbytes(20).hex() + "/x", IN) for _ in range(400)]
    bad = LinkConditions(delay=0.01, loss=0.1, jitter=0.005)
    link = world.link(connect=False, robot={"topics": table}, service={"topics": table}, up=bad, down=bad, record=True)
    link.run(5.0)
    assert len(events(link, SERVICE, Connected)[0][1].topics) == 400
    assert len(set(hellos(link))) > 10
    # Nobody can use the service to send more to a third party than three times what he sent himself.
    assert sum(map(len, welcomes(link))) <= 3 * sum(map(len, hellos(link)))


def test_a_service_topic_for_everything(world):
    robot = {"topics": [Topic("a", "x/y", IN), Topic("b", "x/z", IN, encoding="ros1")]}
    link = world.link(robot=robot, service={"topics": [Topic("*", "*", IN, depth=50)]})
    assert [(t.name, t.encoding, t.depth) for t in link.events[SERVICE][0][1].topics] == [
        ("a", "cdr", 50),
        ("b", "ros1", 50),
    ]
    link.publish(ROBOT, "b", b"hello")
    link.run(0.1)
    assert link.messages[SERVICE][0][1].topic == "b"
    assert [t.topic for t in link.sessions[SERVICE].stats(link.now).topics] == ["a", "b"]


def test_replayed_and_forged_hellos_disturb_nothing(world):
    link = world.link(record=True)
    hello = hellos(link)[0]
    forged = [hello[:-1] + bytes([hello[-1] ^ 1]), hello[:40] + bytes(len(hello) - 40), hello[:31]]
    before = len(link.sent[SERVICE])
    for _ in range(20):
        link.inject(SERVICE, hello)
        for false in forged:
            link.inject(SERVICE, false)
    assert len(link.sent[SERVICE]) == before
    assert rejected(link, SERVICE)["hello_replayed"] == 20
    assert rejected(link, SERVICE)["hello_forged"] == 40
    link.publish(ROBOT, "log", b"still here")
    link.run(1.0)
    assert [m.payload for _, m in link.messages[SERVICE]] == [b"still here"]
    assert all(len(link.events[role]) == 1 for role in Role)


def test_hellos_recorded_before_a_restart_do_not_end_a_session(world):
    link = world.link(record=True)
    for _ in range(6):  # six robots in turn, the service loses its memory in the end
        link.replace(ROBOT, world.session(ROBOT, now=link.now))
        link.run(1.0)
    recorded = list(dict.fromkeys(hellos(link)))
    assert len(recorded) == 7
    link.replace(SERVICE, world.session(SERVICE, now=link.now))
    link.run(1.0)
    for hello in recorded * 3:
        link.inject(SERVICE, hello)
    count = len(link.events[SERVICE])
    link.publish(ROBOT, "log", b"still here")
    link.run(0.5)
    assert [m.payload for _, m in link.messages[SERVICE]] == [b"still here"]
    assert len(link.events[SERVICE]) == count


def test_packets_on_their_way_survive_a_new_handshake(world):
    # The service is slow to answer: what the old robot sent last arrives after the new robot has connected.
    link = world.link(up=LinkConditions(delay=0.01), down=LinkConditions(delay=0.01))
    link.models[ROBOT].conditions = LinkConditions(delay=0.5)
    link.publish(ROBOT, "log", b"old keys")
    link.publish(ROBOT, "scan", b"old value")
    link.run(0.005)
    link.models[ROBOT].conditions = LinkConditions(delay=0.01)
    link.replace(ROBOT, world.session(ROBOT, now=link.now))
    link.run(0.2)
    link.publish(ROBOT, "scan", b"new value")
    link.run(0.8)
    assert [bytes(m.payload) for _, m in link.messages[SERVICE]] == [b"new value", b"old keys"]
    stats = {t.topic: t for t in link.sessions[SERVICE].stats(link.now).topics}
    assert stats["scan"].superseded == 1
    assert "forged" not in rejected(link, SERVICE)


@pytest.mark.slow
def test_used_hellos_and_pending_handshakes_are_bounded(world, topics):
    responder = HandshakeResponder(bytes(32), {t.name: t for t in topics}, world.random.randbytes)
    sizes = []
    for i in range(2 * HandshakeResponder.MAX_USED):
        sizes.append(deep_size(responder) if (i + 1) % HandshakeResponder.MAX_USED == 0 else 0)
        hello = Hello(1, bytes(32), topics[:1], i % 256, NO_KEYS, bytes(8), world.random.randbytes, i)
        answer = responder.answer(hello.common, hello.message, NO_KEYS, {5}, 0.0)
        assert answer.outcome.epoch != 5
    _, full, later = sorted(sizes)[-3:]
    assert later < 1.2 * full


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"session_id": 2**64}, "64 bits"),
        ({"key": b"short"}, "32 bytes"),
        ({"topics": [Topic("a", "x/y", IN)] * 2}, "twice"),
    ],
)
def test_local_misuse_raises(options, word):
    options = {"session_id": 1, "key": bytes(32), "topics": []} | options
    with pytest.raises(ValueError, match=word):
        Session(ROBOT, **options, config=Config(), entropy=bytes, now=0.0)
