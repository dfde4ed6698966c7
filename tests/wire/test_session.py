"""Two whole sessions over made-up links: delivery, priority, roaming, clocks, accounting."""

import math
import subprocess
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.emulator.link_model import LinkConditions
from skytether.wire import Config, PeerMoved, Role
from skytether.wire.codec import packet

ROBOT, SERVICE = Role.ROBOT, Role.SERVICE


def stats_of(link, role):
    return {t.topic: t for t in link.sessions[role].stats(link.time_of(role)).topics}


class Traffic:
    """Publishes numbered random payloads and checks what arrives."""

    SIZES = {"scan": (20, 3000), "camera": (1500, 60_000), "log": (0, 300), "cmd_vel": (0, 1150), "map": (1, 200_000)}

    def __init__(self, link, random, topics):
        self.link = link
        self.random = random
        self.directions = {t.name: t.direction.sender for t in topics}
        self.payloads = {name: [] for name in self.SIZES}

    def publish(self, *names):
        for name in names:
            payload = self.random.randbytes(self.random.randint(*self.SIZES[name]))
            if self.link.publish(self.directions[name], name, payload):
                self.payloads[name].append(payload)

    def check(self):
        """Every delivered payload was published on its topic, and none arrived twice."""
        for role in Role:
            seen = set()
            for _, message in self.link.messages[role]:
                assert self.directions[message.topic] is not role
                assert bytes(message.payload) in self.payloads[message.topic]
                assert (message.topic, message.sequence) not in seen
                seen.add((message.topic, message.sequence))

    def delivered(self, name):
        role = SERVICE if self.directions[name] is ROBOT else ROBOT
        return [bytes(m.payload) for _, m in self.link.messages[role] if m.topic == name]


def test_a_clean_link_delivers_everything_once_in_order(world, topics):
    link = world.link()
    traffic = Traffic(link, world.random, topics)
    link.every(0.05, link.now + 2, lambda: traffic.publish("scan", "camera", "log", "cmd_vel"))
    link.every(0.5, link.now + 2, lambda: traffic.publish("map"))
    link.run(3)
    traffic.check()
    for name, payloads in traffic.payloads.items():
        assert traffic.delivered(name) == payloads
    for role in Role:
        assert not link.sessions[role].stats(link.now).rejected


conditions = st.builds(
    LinkConditions,
    delay=st.sampled_from([0.0, 0.005, 0.1]),
    jitter=st.sampled_from([0.0, 0.001, 0.03]),
    loss=st.sampled_from([0.0, 0.01, 0.1, 0.4]),
    burst=st.sampled_from([None, 4]),
    rate=st.sampled_from([None, 2e6, 50e6]),
    reorder=st.sampled_from([0.0, 0.1]),
    duplicate=st.sampled_from([0.0, 0.05]),
    seed=st.integers(0, 2**32),
)


@pytest.mark.slow
@given(
    up=conditions, down=conditions, corrupt=st.sampled_from([0.0, 0.05]), mtu=st.sampled_from([512, 1200, 9000]),
    seed=st.integers(0, 2**32),
)  # fmt: skip
@settings(max_examples=15)
def test_on_any_link_only_what_was_published_arrives_and_at_most_once(make_world, topics, up, down, corrupt, mtu, seed):
    world = make_world(seed)
    config = {"config": Config(mtu=mtu, max_mtu=mtu)}
    link = world.link(
        connect=False, robot=config, service=config, up=up, down=down, corrupt=corrupt, seed=seed, mtu=9000, record=True
    )
    traffic = Traffic(link, world.random, topics)
    link.every(0.05, 1.0, lambda: traffic.publish(*world.random.sample(list(Traffic.SIZES), 2)))
    link.run(2)
    traffic.check()
    for role in Role:
        assert not link.dropped[role]
        assert all(len(p) <= mtu for _, p in link.sent[role])
    check_nonces(link)
    check_accounts(link, settled=False)


def check_nonces(link):
    """Under one handshake's keys, one number seals one message, and one packet number of a path one packet."""
    for role in Role:
        sealed, packets = {}, {}
        for _, data in link.sent[role]:
            kind, packet_id, _, number, _, length, block, index, path, packet_number, _ = packet.pull_header(data)
            if kind in (packet.DATA, packet.SHARD):
                assert packets.setdefault((packet_id, path, packet_number), data) == data
            if kind == packet.SHARD:
                shard = data[: packet.COMMON_SIZE], len(data), data[packet.SHARD_AT :]
                assert sealed.setdefault((packet_id, number, block, index, len(data)), shard) == shard
                assert sealed.setdefault((packet_id, number), (length, shard[0])) == (length, shard[0])


def check_accounts(link, settled):
    """Sent = delivered + superseded + lost, once nothing is under way any more."""
    for receiver in Role:
        sender = ROBOT if receiver is SERVICE else SERVICE
        ours, theirs = stats_of(link, receiver), stats_of(link, sender)
        for name, row in ours.items():
            if (row.direction == "in") != (receiver is SERVICE):
                continue
            sent = theirs[name].sent
            arrived = row.delivered + row.superseded
            assert arrived + row.lost <= sent
            assert theirs[name].offered >= sent + theirs[name].replaced
            if settled:
                assert arrived + row.lost == sent
                assert row.sent == sent
                assert theirs[name].delivered == row.delivered
                assert theirs[name].lost == row.lost
                assert theirs[name].bytes_delivered == row.bytes_delivered
                assert row.bytes_sent == theirs[name].bytes_sent


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "bad",
    [
        LinkConditions(delay=0.05, jitter=0.02, loss=0.2, duplicate=0.1),
        LinkConditions(delay=0.02, loss=0.1, burst=6, reorder=0.2, reorder_by=0.05),
    ],
)
def test_the_books_balance_in_the_end(make_world, topics, bad, seed):
    world = make_world(seed)
    link = world.link(connect=False, up=bad, down=bad)
    link.run(3)
    traffic = Traffic(link, world.random, topics)
    link.every(0.02, link.now + 3, lambda: traffic.publish("scan", "log", "cmd_vel"))
    link.every(0.1, link.now + 3, lambda: traffic.publish("camera", "map"))
    link.run(4)
    link.models[ROBOT].conditions = link.models[SERVICE].conditions = LinkConditions()
    link.run(8)
    traffic.check()
    check_accounts(link, settled=True)
    for role in Role:
        for row in stats_of(link, role).values():
            assert row.offered == row.sent + row.replaced + row.expired or row.expired
            assert row.delivered == len(traffic.delivered(row.topic))


@pytest.mark.slow
def test_delivery_meets_its_target_at_the_assumed_loss(world, topics):
    loss = LinkConditions(delay=0.02, loss=0.05, seed=5)
    link = world.link(connect=False, up=loss, down=loss)
    link.run(3)
    traffic = Traffic(link, world.random, topics)
    traffic.SIZES = {"scan": (2222, 2222), "camera": (47_611, 47_611), "log": (60, 60), "cmd_vel": (80, 80)}
    link.every(0.04, link.now + 24, lambda: traffic.publish("scan", "log", "cmd_vel", "camera"))
    link.run(25)
    traffic.check()
    for topic in topics:
        if topic.name in traffic.SIZES:
            count = len(traffic.payloads[topic.name])
            assert count == 600
            missing = count - len(traffic.delivered(topic.name))
            expected = count * (1 - topic.delivery)
            assert missing <= expected + 4 * math.sqrt(expected)
    # And it costs no more than it has to: 40 shards need 6 more for 0.99, a small message one copy, headers 3 %.
    rows = stats_of(link, ROBOT)
    assert rows["camera"].bytes_sent / rows["camera"].bytes_delivered < 1.25


def test_under_pressure_old_messages_go_and_high_priorities_stay(world):
    link = world.link(robot={"config": Config(rate_bps=2e6)})
    link.every(
        0.05,
        link.now + 3,
        lambda: (link.publish(ROBOT, "camera", bytes(40_000)), link.publish(ROBOT, "scan", b"s" * 2000)),
    )
    link.run(5)
    rows = stats_of(link, ROBOT)
    assert rows["scan"].delivered == 60
    assert rows["camera"].replaced + rows["camera"].expired > 30
    assert rows["camera"].delivered > 5
    assert rows["camera"].delay_max < 2.1  # queue and reassembly each at most a lifespan of 0.5 s, and the path
    check_accounts(link, settled=True)


def test_newest_value_topics_supersede_and_others_do_not(world):
    link = world.link()
    link.models[ROBOT].conditions = LinkConditions(delay=0.1)
    link.publish(ROBOT, "scan", b"1")
    link.publish(ROBOT, "log", b"1")
    link.run(0.01)
    link.models[ROBOT].conditions = LinkConditions()
    link.publish(ROBOT, "scan", b"2")
    link.publish(ROBOT, "log", b"2")
    link.run(1.0)
    received = [(m.topic, m.payload) for _, m in link.messages[SERVICE]]
    assert sorted(received) == [("log", b"1"), ("log", b"2"), ("scan", b"2")]
    row = stats_of(link, SERVICE)["scan"]
    assert (row.superseded, row.lost, row.late, row.delivered) == (1, 0, 0, 1)


def test_the_answer_follows_a_robot_that_moves(world):
    delay = LinkConditions(delay=0.01)
    link = world.link(up=delay, down=delay)
    link.every(0.01, link.now + 1, lambda: link.publish(SERVICE, "cmd_vel", b"go"))
    link.run(0.3)
    link.addresses[ROBOT] = "new"
    link.publish(ROBOT, "log", b"moved")
    moved, before = link.now, len(link.messages[ROBOT])
    link.run(0.5)
    assert [e for _, e in link.events[SERVICE][1:]] == [PeerMoved("new")]
    first = next(t for t, _ in link.messages[ROBOT][before:])
    assert first - moved <= 0.02 + 0.011
    assert link.sessions[SERVICE].stats(link.now).paths[0].address == "new"
    assert link.sessions[SERVICE].stats(link.now).handshakes == 1


def test_old_and_false_packets_from_elsewhere_move_nothing(world):
    link = world.link(record=True)
    link.publish(ROBOT, "camera", bytes(5000))
    link.models[ROBOT].conditions = LinkConditions(cut=True)
    link.publish(ROBOT, "log", b"kept back")  # recorded, not delivered
    kept = [p for _, p in link.sent[ROBOT]][-1]
    link.models[ROBOT].conditions = LinkConditions()
    link.publish(ROBOT, "log", b"newer")
    link.run(0.5)
    for _, data in link.sent[ROBOT]:
        link.inject(SERVICE, data, "thief")
        link.inject(SERVICE, data[:-1] + bytes([data[-1] ^ 1]), "thief")
    assert link.sessions[SERVICE].stats(link.now).paths[0].address == "robot"
    # The one kept back was authentic and new, so it counts; but it is not the newest, so nothing moves.
    assert packet.pull_header(kept)[4] == 3
    assert [m.payload for _, m in link.messages[SERVICE] if m.topic == "log"] == [b"newer", b"kept back"]


@pytest.mark.parametrize("clock", [(0.0, 0.0), (5000.0, 50e-6), (123.4, -50e-6)])
def test_delays_are_right_within_their_stated_error(world, clock):
    up, down = LinkConditions(delay=0.08, jitter=0.01), LinkConditions(delay=0.02, jitter=0.01)
    link = world.link(up=up, down=down, service_clock=clock)
    published = {}

    def publish():
        for role, topic in ((ROBOT, "log"), (SERVICE, "cmd_vel")):
            payload = world.random.randbytes(10)
            published[payload] = link.now
            link.publish(role, topic, payload)

    link.every(0.05, link.now + 12, publish)
    link.run(13)
    assert link.sessions[ROBOT].stats(link.now).clock_error < 0.05
    for role in Role:
        for at, message in link.messages[role]:
            true = link.service_time(published[message.payload]) if role is SERVICE else published[message.payload]
            assert abs(message.sent_at - true) <= message.sent_at_error + 2e-5
            local = link.service_time(at) if role is SERVICE else at
            assert message.received_at == pytest.approx(local)
    session = link.sessions[SERVICE].stats(link.service_time(link.now))
    assert abs(session.clock_offset - (link.now - link.service_time(link.now))) <= session.clock_error
    row = stats_of(link, SERVICE)["log"]
    assert row.delay_p50 == pytest.approx(0.08, abs=row.delay_error + 0.003)
    path = link.sessions[ROBOT].stats(link.now).paths[0]
    assert path.rtt_p50 == pytest.approx(0.1, rel=0.1)


@pytest.mark.slow
def test_both_ends_know_the_losses_of_both_directions(world):
    up, down = LinkConditions(loss=0.1, seed=1), LinkConditions(loss=0.03, burst=3, seed=2)
    link = world.link(connect=False, up=up, down=down)
    link.run(1)
    link.every(0.005, link.now + 20, lambda: (link.publish(ROBOT, "log", b""), link.publish(SERVICE, "cmd_vel", b"")))
    link.run(20)
    robot, service = (link.sessions[role].stats(link.now).paths[0] for role in (ROBOT, SERVICE))
    assert service.loss_in == pytest.approx(0.1, abs=0.02)
    assert robot.loss_in == pytest.approx(0.03, abs=0.015)
    assert robot.burst_in == pytest.approx(3, rel=0.35)
    assert robot.loss_out == pytest.approx(service.loss_in, abs=0.02)
    assert service.loss_out == pytest.approx(robot.loss_in, abs=0.02)
    assert robot.packets_sent > service.packets_received > 0


def test_publishing_what_cannot_be_sent(world):
    link = world.link(connect=False, up=LinkConditions(cut=True))
    robot = link.sessions[ROBOT]
    assert robot.publish("scan", b"x", 0.0) is False
    for name in ("cmd_vel", "nonsense"):
        with pytest.raises(KeyError, match=name):
            robot.publish(name, b"x", 0.0)
    link.models[ROBOT].conditions = LinkConditions()
    link.run(6)
    with pytest.raises(KeyError, match="nonsense"):
        robot.publish("nonsense", b"x", link.now)
    with pytest.raises(ValueError, match=r"scan.*16777217 bytes"):
        robot.publish("scan", bytes(2**24 + 1), link.now)
    robot.close(link.now)
    assert robot.publish("scan", b"x", link.now) is False


def test_a_topic_that_the_peer_does_not_have_is_not_sent(world, topics):
    link = world.link(service={"topics": topics[1:]})
    assert link.publish(ROBOT, "scan", b"x") is False
    assert link.publish(ROBOT, "log", memoryview(b"x")) is True


@pytest.mark.slow
def test_the_largest_message_arrives(world, fast):
    link = world.link(robot={"config": fast}, service={"config": fast}, down=LinkConditions(loss=0.03))
    payload = world.random.randbytes(16 * 2**20)
    link.publish(SERVICE, "map", payload)
    link.run(1.0)
    assert [bytes(m.payload) for _, m in link.messages[ROBOT]] == [payload]


def test_an_idle_session_is_cheap(world):
    link = world.link(record=True)
    before = sum(len(p) for _, p in link.sent[ROBOT])
    link.run(10)
    assert (sum(len(p) for _, p in link.sent[ROBOT]) - before) * 8 / 10 < 20_000


SECONDS_OF_COMMANDS = """
import os, sys
from skytether.testing.link import LossyLink
from skytether.wire import Role, Session
from skytether.wire.topic import Direction, Topic

topics = (Topic("cmd_vel", "geometry_msgs/msg/Twist", Direction.OUT), Topic("odom", "nav_msgs/Odometry", Direction.IN))
key = os.urandom(32)
robot, service = (Session(role, 1, key, topics, entropy=os.urandom, now=0.0) for role in (Role.ROBOT, Role.SERVICE))
link = LossyLink(robot, service)
link.run(0.1)
loaded = set(sys.modules)
for _ in range(200):
    for topic in topics:
        assert link.publish(topic.direction.sender, topic.name, bytes(100))
    link.run(0.01)
print(*sorted(set(sys.modules) - loaded))
"""


@pytest.mark.slow
def test_nothing_is_loaded_while_commands_flow():
    """A module that the first seconds of a session load stands in the way of its commands, for 20 ms once."""
    done = subprocess.run([sys.executable, "-c", SECONDS_OF_COMMANDS], capture_output=True, text=True, timeout=60)
    assert (done.stdout.strip(), done.stderr) == ("", "")


def test_no_counter_goes_down_and_the_books_balance_when_the_service_is_restarted(world):
    bad = LinkConditions(delay=0.05, jitter=0.02, loss=0.05)
    link = world.link(up=bad, down=bad)
    before = {}

    def look():
        for row in stats_of(link, ROBOT).values():
            counts = (
                row.offered, row.sent, row.delivered, row.lost + row.late, row.late, row.expired, row.replaced,
                row.superseded, row.duplicate, row.unknown, row.bytes_sent, row.bytes_delivered,
            )  # fmt: skip
            assert all(a <= b for a, b in zip(before.get(row.topic, counts), counts, strict=True)), row
            before[row.topic] = counts

    def publish():
        link.publish(ROBOT, "scan", b"x" * 500)
        link.publish(SERVICE, "cmd_vel", b"y" * 80)

    link.every(0.04, link.now + 3, publish)
    link.every(0.1, link.now + 5, look)
    for _ in range(2):
        link.run(1)
        link.replace(SERVICE, world.session(SERVICE, now=link.service_time(link.now)))
    link.run(3)
    scan, command = stats_of(link, ROBOT)["scan"], stats_of(link, ROBOT)["cmd_vel"]
    assert scan.unknown > 0 == command.unknown
    for row in (scan, command):
        assert row.sent > 50
        assert row.sent == row.delivered + row.superseded + row.lost + row.unknown
    assert command.delivered == len([m for _, m in link.messages[ROBOT] if m.topic == "cmd_vel"])
