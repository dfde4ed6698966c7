"""New keys while the old ones are in use: nothing is lost, nothing waits, the id on the wire changes."""

from itertools import pairwise

import pytest
from insider import epoch_of

from skytether.emulator.link_model import LinkConditions
from skytether.wire import Config, Connected, Direction, Disconnected, Role, Topic
from skytether.wire.codec import packet
from skytether.wire.state.epoch import MAX_BYTES, Epoch

ROBOT, SERVICE = Role.ROBOT, Role.SERVICE
LINK = {"up": LinkConditions(delay=0.03), "down": LinkConditions(delay=0.03)}


def ids(link, role, since=0.0):
    """Of packets with messages, in order of first use."""
    sent = (p for at, p in link.sent[role] if at >= since and p[0] not in (packet.HELLO, packet.WELCOME))
    return list(dict.fromkeys(packet.pull_header(p)[1] for p in sent))


def ends(link):
    return [link.sessions[role].stats(link.time_of(role)) for role in Role]


def test_keys_change_with_time(world):
    link = world.link(robot={"config": Config(rekey_after=2.0)}, record=True, **LINK)
    link.run(10.0)
    assert [stats.handshakes for stats in ends(link)] == [6, 6]
    assert len(ids(link, ROBOT)) == len(ids(link, SERVICE)) == 6
    for role in Role:
        assert [type(event) for _, event in link.events[role]] == [Connected]
    assert ends(link)[1].paths[0].loss_in < 0.01


@pytest.mark.parametrize("sender", Role)
def test_keys_change_with_volume_in_either_direction(world, sender):
    link = world.link(robot={"config": Config(rekey_bytes=1_000_000)}, **LINK)
    topic = "camera" if sender is ROBOT else "map"
    link.every(0.02, link.now + 4.0, lambda: link.publish(sender, topic, bytes(20_000)))
    link.run(5.0)
    assert 4 <= ends(link)[0].handshakes <= 6


@pytest.mark.parametrize("loss", [0.0, 0.1])
def test_nothing_is_lost_and_nothing_waits_while_keys_change_under_load(world, loss):
    config = Config(rekey_after=0.7, assumed_loss=0.1)
    link = world.link(
        robot={"config": config}, service={"config": Config(assumed_loss=0.1)}, record=True,
        up=LinkConditions(delay=0.03, jitter=0.005, loss=loss), down=LinkConditions(delay=0.03, loss=loss),
    )  # fmt: skip
    sent = {role: [] for role in Role}

    def publish():
        for role, topic, size in ((ROBOT, "log", 60), (ROBOT, "camera", 30_000), (SERVICE, "cmd_vel", 60)):
            payload = len(sent[role]).to_bytes(4, "big") + world.random.randbytes(size)
            sent[role].append((topic, payload))
            link.publish(role, topic, payload)

    start = link.now
    link.every(0.04, start + 7.0, publish)
    link.run(8.0)
    assert all(stats.handshakes >= 8 for stats in ends(link))
    for role, other in ((ROBOT, SERVICE), (SERVICE, ROBOT)):
        arrived = {(m.topic, bytes(m.payload)) for _, m in link.messages[other]}
        missing = [payload for payload in sent[role] if payload not in arrived]
        if loss:
            assert len(missing) <= 0.01 * len(sent[role])  # what redundancy is meant to leave, and no more
        else:
            assert missing == []
        assert not any(isinstance(event, Disconnected) for _, event in link.events[role])
    times = [at for at, m in link.messages[ROBOT] if m.topic == "cmd_vel"]
    assert max(b - a for a, b in pairwise(times)) < (0.12 if loss else 0.05)


def test_reliable_topics_lose_repeat_and_reorder_nothing(world):
    topics = (
        Topic("events", "a/B", Direction.IN, lifespan=60.0, depth=1000, reliable=True),
        Topic("maps", "a/M", Direction.OUT, lifespan=60.0, depth=100, reliable=True),
    )
    bad = LinkConditions(delay=0.03, jitter=0.01, loss=0.1)
    robot = {"topics": topics, "config": Config(rekey_after=0.3, old_keys=0.2)}
    link = world.link(robot=robot, service={"topics": topics, "config": Config(old_keys=0.2)}, up=bad, down=bad)
    sent = {ROBOT: [], SERVICE: []}

    def publish():
        for role, topic, size in ((ROBOT, "events", 100), (SERVICE, "maps", 40_000)):
            sent[role].append(world.random.randbytes(size))
            assert link.publish(role, topic, sent[role][-1])

    link.every(0.05, link.now + 3.0, publish)
    link.run(12.0)
    assert all(stats.handshakes >= 15 for stats in ends(link))
    for role, other in ((ROBOT, SERVICE), (SERVICE, ROBOT)):
        assert [bytes(m.payload) for _, m in link.messages[other]] == sent[role]


def test_a_large_message_under_way_is_finished_under_the_keys_that_it_began_with(world):
    slow = Config(rate_bps=4e6, rekey_after=1.5, old_keys=0.2)
    table = Topic("log", "a/msg/B", Direction.IN, lifespan=10.0), Topic("map", "a/msg/B", Direction.OUT, lifespan=5.0)
    robot, service = {"config": slow, "topics": table}, {"config": Config(old_keys=0.2), "topics": table}
    link = world.link(robot=robot, service=service, record=True, **LINK)
    link.run(0.2)
    payload = world.random.randbytes(900_000)  # some 2 s
    link.publish(SERVICE, "map", payload[:1000])
    link.publish(ROBOT, "log", payload)
    link.run(5.0)
    assert [bytes(m.payload) for _, m in link.messages[SERVICE]] == [payload]
    assert ends(link)[1].handshakes >= 3


def test_the_id_before_is_good_for_nothing_afterwards(world):
    link = world.link(
        robot={"config": Config(rekey_after=1.0, old_keys=0.3)}, service={"config": Config(old_keys=0.3)},
        record=True, **LINK,
    )  # fmt: skip
    link.run(3.0)
    first = ids(link, ROBOT)[0]
    old = next(p for _, p in link.sent[ROBOT] if packet.pull_header(p)[1] == first and p[0] == packet.DATA)
    before = link.sessions[SERVICE].stats(link.now)
    link.inject(SERVICE, old, "elsewhere")
    after = link.sessions[SERVICE].stats(link.now)
    assert after.rejected["session"] == before.rejected.get("session", 0) + 1
    assert after.paths[0].packets_received == before.paths[0].packets_received


def test_a_link_that_is_cut_while_keys_change_comes_back(world):
    link = world.link(record=True, **LINK)
    for cut in (0.01, 0.04, 0.07):  # HELLO, WELCOME or the first packet under the new keys is lost
        link.sessions[ROBOT].rekey(link.now)
        link.run(cut)
        for road in link.roads.values():
            road.set(LinkConditions(cut=True))
        link.run(3.0)
        road.set(LinkConditions(delay=0.03))
        link.run(0.5)
        assert all(stats.connected for stats in ends(link))
        link.publish(ROBOT, "scan", b"x")
        link.publish(SERVICE, "cmd_vel", b"y")
        link.run(0.2)
        assert [bytes(link.messages[role][-1][1].payload) for role in (SERVICE, ROBOT)] == [b"x", b"y"]
    assert [stats.handshakes for stats in ends(link)] == [4, 4]


def test_only_the_robots_end_asks_for_new_keys(world):
    with pytest.raises(ValueError, match="only the robot's end"):
        world.link().sessions[SERVICE].rekey(1.0)


def test_nothing_is_sent_with_keys_that_are_used_up(world):
    link = world.link(record=True, **LINK)
    epoch_of(link.sessions[SERVICE]).bytes_sent = MAX_BYTES  # 128 GiB take a while
    sent = len(link.sent[SERVICE])
    link.publish(SERVICE, "map", b"x")
    link.run(0.05)
    assert len(link.sent[SERVICE]) == sent
    link.run(2.0)  # nobody hears it, so the robot asks, and new keys are made
    assert bytes(link.messages[ROBOT][-1][1].payload) == b"x"


def test_a_copy_of_the_message_that_confirmed_new_keys_is_no_new_message(world):
    before = epoch_of(world.link(**LINK).sessions[SERVICE])
    after = Epoch(before.id + 1, before.ciphers, before.topics, [], [], before.life)
    number = before.replay.highest + 3
    assert after.replay.accept(number)
    assert after.take_over(before)
    assert not after.replay.accept(number)
    assert after.replay.accept(number - 1)
