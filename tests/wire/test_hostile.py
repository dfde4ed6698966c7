"""Any bytes, any time: nothing raises, nothing grows beyond its bound, nothing but a counter changes."""

import tracemalloc
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.emulator.link_model import LinkConditions
from skytether.wire import Config, Role
from skytether.wire.codec import packet
from skytether.wire.codec.plaintext import OVERHEAD

ROBOT, SERVICE = Role.ROBOT, Role.SERVICE
SESSION_ID = 0x1122334455667788
REASONS = {
    "short", "version", "session", "type", "epoch", "path", "topic", "shape", "too_large", "implausible", "old",
    "forged", "repeated", "evicted", "unasked", "control", "compressed", "hello_forged", "hello_replayed",
    "hello_malformed", "welcome_forged",
}  # fmt: skip
"""Bounded, for metrics."""


def state(link, role):
    """What a stranger's packets must not change."""
    stats = link.sessions[role].stats(link.time_of(role))
    topics = [(t.topic, t.delivered, t.lost, t.late, t.superseded, t.sent, t.bytes_delivered) for t in stats.topics]
    paths = [(p.address, p.rtt) for p in stats.paths]
    return topics, paths, stats.connected, stats.handshakes, stats.clock_offset, len(link.events[role])


def forged(random, seen):
    """A packet that is as plausible as a stranger can make it who has seen one of the session's packets."""
    _, packet_id, epoch, *_ = packet.pull_header(seen)
    size = random.choice((1, 100, 300, 1168))
    length = random.choice((0, 1, size, 2 * size, 30 * size, 16 * 2**20 + OVERHEAD, 2**32 - 1))
    common = packet.push_common(
        random.choice((packet.DATA, packet.SHARD) * 4 + (packet.HELLO, packet.WELCOME, 0x13, 0x2F)),
        random.choice((packet_id,) * 16 + (SESSION_ID,) * 3 + (random.getrandbits(64),)),
        epoch if random.random() < 0.9 else random.randrange(256),
        random.choice((random.randrange(100), random.randrange(70_000), random.getrandbits(48))),
        random.choice((0, 1, 2, 3, 4, 5, 6, 65_535)),
        length,
    )
    header = packet.push_shard(
        random.choice((0, 0, 1, 65_535)),
        random.randrange(256),
        random.choice((0,) * 9 + (7,)),
        random.getrandbits(32),
        random.getrandbits(16),
    )
    return common + header + random.randbytes(8 + size)


@pytest.fixture(scope="module")
def live(make_world):
    """A session with traffic behind it, and everything it sent."""
    link = make_world(1).link(record=True)
    for _ in range(5):
        for topic in ("scan", "camera", "log"):
            link.publish(ROBOT, topic, bytes(5000))
        link.publish(SERVICE, "cmd_vel", bytes(80))
        link.run(0.1)
    link.run(0.02)
    link.arrived = {role: [p for _, p in link.sent[role]] for role in Role}  # nothing is on its way
    return link


def test_what_names_another_session_is_no_traffic_of_the_path(live):
    for role in Role:
        before = live.sessions[role].stats(live.now).paths[0]
        stranger = bytearray(live.sent[SERVICE if role is ROBOT else ROBOT][-1][1])
        stranger[1] ^= 1
        for data in (bytes(stranger), bytes(len(stranger)), b""):
            live.inject(role, data, "stranger")
        after = live.sessions[role].stats(live.now).paths[0]
        assert (after.packets_received, after.bytes_received) == (before.packets_received, before.bytes_received)


@given(data=st.binary(max_size=2000), segment=st.none() | st.integers(-1, 2000), path=st.integers(0, 1))
@settings(max_examples=80)
def test_any_bytes(live, data, segment, path):
    for role in Role:
        before = state(live, role)
        live.sessions[role].receive(data, "stranger", live.now, segment=segment, path=path)
        assert live.sessions[role].next_event() is None
        assert live.sessions[role].transmit(live.now) == []
        assert state(live, role) == before


@pytest.mark.slow
@given(seed=st.integers(0, 2**32))
@settings(max_examples=40)
def test_plausible_forgeries_alone_and_in_batches(live, seed):
    random = Random(seed)
    for role in Role:
        other = SERVICE if role is ROBOT else ROBOT
        seen = live.sent[other][-1][1]
        before, sent = state(live, role), live.sessions[role].stats(live.now).paths[0].packets_sent
        for _ in range(60):
            one = forged(random, seen)
            live.inject(role, one)
            count = random.randint(2, 64)
            batch = bytearray(one * count)
            for i in range(count):  # indices in any order, some repeated, a few packets of other messages
                batch[i * len(one) + packet.INDEX_AT] = random.choice((i, random.randrange(256)))
                if random.random() < 0.03:
                    batch[i * len(one) + random.randrange(packet.HEADER_SIZE)] ^= 1
            live.inject(role, bytes(batch[: len(batch) - random.choice((0, 1, len(one) // 2))]), segment=len(one))
        assert state(live, role) == before
        assert live.sessions[role].stats(live.now).paths[0].packets_sent == sent
        assert set(live.sessions[role].stats(live.now).rejected) <= REASONS


@given(seed=st.integers(0, 2**32))
@settings(max_examples=40)
def test_what_was_sent_before_repeated_cut_and_changed(live, seed):
    random = Random(seed)
    for role in Role:
        recorded = live.arrived[SERVICE if role is ROBOT else ROBOT]
        before = state(live, role)
        for _ in range(150):
            data = bytearray(random.choice(recorded))
            how = random.randrange(4)
            if how == 1:
                del data[random.randrange(len(data)) :]
            elif how == 2:
                data[random.randrange(len(data))] ^= 1 << random.randrange(8)
            elif how == 3:
                data += random.randbytes(random.randrange(1, 40))
            live.inject(role, bytes(data))
        assert state(live, role) == before


@pytest.mark.slow
def test_a_flood_stays_in_its_bound_and_real_messages_arrive(make_world):
    config = Config(max_message=200_000, reassembly_limit=400_000)
    world = make_world(2)
    delay = LinkConditions(delay=0.005)
    robot = {"config": Config(rate_bps=1e9)}  # a message that takes long to send is evicted by the flood meanwhile
    link = world.link(robot=robot, service={"config": config}, up=delay, down=delay, record=True)
    _, packet_id, epoch, *_ = packet.pull_header(link.sent[ROBOT][-1][1])
    sent = []

    def flood():
        # 600 forged packets of a topic's own kind every 10 ms: 560 Mbit/s beside 4 Mbit/s of real messages.
        for i in range(100):
            length = 30 * 1160
            number = world.random.randrange(60_000)
            common = packet.push_common(packet.SHARD, packet_id, epoch, number, 1 + i % 2, length)
            rows = b"".join(common + packet.push_shard(0, j, 0, j, 0) + bytes(1168) for j in range(6))
            link.inject(SERVICE, rows, segment=1200)
            assert link.sessions[SERVICE].stats(link.now).reassembly_bytes <= 25_000  # of real messages only

    def publish():
        sent.append(world.random.randbytes(20_000))
        link.publish(ROBOT, "camera", sent[-1])

    link.every(0.01, link.now + 0.4, flood)
    link.every(0.04, link.now + 0.4, publish)
    link.run(1.5)
    assert [bytes(m.payload) for _, m in link.messages[SERVICE]] == sent
    assert link.sessions[SERVICE].stats(link.now).rejected["forged"] >= 600 * 39
    assert link.sessions[SERVICE].stats(link.now).reassembly_bytes == 0


def test_a_closed_session_takes_nothing(world):
    link = world.link(record=True)
    link.sessions[SERVICE].close(link.now)
    link.sessions[SERVICE].close(link.now)
    link.run(0.1)
    before = state(link, SERVICE)
    for _, data in link.sent[ROBOT]:
        link.inject(SERVICE, data)
    assert state(link, SERVICE) == before
    assert link.sessions[SERVICE].next_timer() is None


@given(seed=st.integers(0, 2**32))
@settings(max_examples=10)
def test_a_stranger_cannot_bring_an_end_up(make_world, seed):
    world = make_world(seed)
    service = world.session(SERVICE)
    for _ in range(100):
        seen = packet.push_common(packet.DATA, world.random.getrandbits(64), world.random.randrange(256), 0, 0, 0)
        service.receive(forged(world.random, seen.ljust(40)), "stranger", 0.0)
        assert service.transmit(0.0) == []
    assert service.next_event() is None
    assert service.next_timer() is None


@pytest.mark.slow
def test_memory_of_a_flooded_end_is_bounded(make_world):
    """Forged shards of all sizes, forged and repeated HELLOs, what was sent before: measured, not counted."""
    config = Config(max_message=100_000, reassembly_limit=400_000, queue_limit=200_000)
    world = make_world(3)
    link = world.link(robot={"config": config}, service={"config": config}, record=True)
    link.publish(ROBOT, "log", bytes(5000))
    link.run(0.1)
    seen = link.sent[ROBOT][-1][1]
    session, random = link.sessions[SERVICE], world.random
    recorded = [p for _, p in link.sent[ROBOT]]

    def flood(count):
        for i in range(count):
            session.receive(forged(random, seen), f"stranger {i}", link.now)
            session.receive(random.choice(recorded), f"stranger {i}", link.now)
            hello = packet.push_common(packet.HELLO, SESSION_ID, 0, random.getrandbits(48), 0, 182 * 1100)
            session.receive(hello + packet.push_shard(0, i % 200, 0, 0, 0) + random.randbytes(1108), "x", link.now)
            for _ in iter(session.next_event, None):
                pass
            session.transmit(link.now)

    flood(500)  # caches of what is used for the first time
    tracemalloc.start()
    try:
        flood(6000)
        used, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert used < 100_000  # of 10 MB that came: counters
