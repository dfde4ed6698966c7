"""Who sees packets and sends others from elsewhere: no packet but the peer's own is believed in anything."""

from dataclasses import replace
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.emulator.link_model import LinkConditions
from skytether.wire import Config, Role
from skytether.wire.codec import packet

ROBOT, SERVICE = Role.ROBOT, Role.SERVICE
DELAY = LinkConditions(delay=0.02)


def row(link, role, topic):
    return next(t for t in link.sessions[role].stats(link.time_of(role)).topics if t.topic == topic)


def all_but_rejected(link, role):
    """Everything that an end tells, but what it refused."""
    stats = replace(link.sessions[role].stats(link.time_of(role)), rejected={})
    return repr(stats), len(link.events[role]), len(link.messages[role]), len(link.sent[role])  # NaN equals nothing


@pytest.fixture(scope="module")
def live(make_world):
    """A session with traffic behind it, and what each end sent that never arrived."""
    link = make_world(1).link(record=True)
    link.lost = {role: [] for role in Role}
    for road in link.roads.values():
        road.set(LinkConditions(cut=True))
    for _ in range(3):
        link.publish(ROBOT, "scan", bytes(100))
        link.publish(ROBOT, "camera", bytes(9000))
        link.publish(SERVICE, "map", bytes(5000))
        link.run(0.01)
    for role in Role:
        link.lost[role] = [p for at, p in link.sent[role] if at > 1.0]
        assert {p[0] for p in link.lost[role]} >= {packet.DATA, packet.SHARD}
    return link


@given(seed=st.integers(0, 2**32), batch=st.booleans())
@settings(max_examples=60, deadline=None)
def test_any_flipped_bit_anywhere_changes_nothing_but_a_counter(live, seed, batch):
    random = Random(seed)
    role = random.choice(list(Role))
    sent = live.lost[SERVICE if role is ROBOT else ROBOT]
    before = all_but_rejected(live, role)
    refused = sum(live.sessions[role].stats(live.now).rejected.values())
    shards = [p for p in sent if p[0] == packet.SHARD and len(p) == len(sent[-1])] if batch else []
    chosen = shards[:4] if len(shards) >= 4 else [random.choice(sent)]
    changed = []
    for one in chosen:
        data = bytearray(one)
        data[random.randrange(len(data))] ^= 1 << random.randrange(8)
        changed.append(bytes(data))
    live.inject(role, b"".join(changed), "stranger", segment=len(changed[0]) if len(changed) > 1 else None)
    assert all_but_rejected(live, role) == before
    assert sum(live.sessions[role].stats(live.now).rejected.values()) == refused + len(changed)


@given(seed=st.integers(0, 2**32))
@settings(max_examples=30, deadline=None)
def test_what_is_cut_or_grown_changes_nothing_either(live, seed):
    random = Random(seed)
    role = random.choice(list(Role))
    one = random.choice(live.lost[SERVICE if role is ROBOT else ROBOT])
    before = all_but_rejected(live, role)
    for data in (one[: 4 * random.randrange(len(one) // 4)], one + bytes(4 * random.randint(1, 20))):
        live.inject(role, data, "stranger")
    assert all_but_rejected(live, role) == before


def test_false_packet_numbers_make_nobody_believe_in_loss(world):
    """Item 8, first attack: ten packets a second with the session's id and made-up numbers."""
    link = world.link(record=True, up=DELAY, down=DELAY)

    def attack():
        seen = link.sent[ROBOT][-1][1]
        fields = list(packet.pull_header(seen))
        fields[9] = (fields[9] + 60_000) % 2**32
        false = packet.push_common(*fields[:6]) + packet.push_shard(*fields[6:]) + seen[packet.HEADER_SIZE :]
        link.inject(SERVICE, false, "elsewhere")

    link.every(0.01, link.now + 5.0, lambda: link.publish(ROBOT, "scan", bytes(100)))
    link.every(0.1, link.now + 5.0, attack)
    link.run(6.0)
    paths = {role: link.sessions[role].stats(link.now).paths[0] for role in Role}
    assert paths[SERVICE].loss_in < 0.02
    assert paths[ROBOT].loss_out < 0.02
    assert row(link, SERVICE, "scan").lost == 0
    assert link.sessions[SERVICE].stats(link.now).rejected == {"forged": 50}


def test_a_false_shard_for_each_message_costs_none(world):
    """Item 8, second attack: one shard with made-up bytes for each large message, before the real ones."""
    link = world.link(record=True, up=LinkConditions(delay=0.05))
    sent = []

    def publish():
        sent.append(world.random.randbytes(20_000))
        link.publish(ROBOT, "camera", sent[-1])
        link.run(0.001)
        first = next(p for _, p in reversed(link.sent[ROBOT]) if p[0] == packet.SHARD)
        for at in (packet.SHARD_AT, len(first) - 1):
            false = bytearray(first)
            false[at] ^= 0xFF
            link.inject(SERVICE, bytes(false), "elsewhere")
        others = first[: packet.SHARD_AT] + bytes(len(first) - packet.SHARD_AT)
        link.inject(SERVICE, others * 10, "elsewhere", segment=len(others))

    for _ in range(20):
        publish()
        link.run(0.05)
    link.run(1.0)
    assert [bytes(m.payload) for _, m in link.messages[SERVICE]] == sent
    assert link.sessions[SERVICE].stats(link.now).rejected == {"forged": 20 * 12}


def test_packets_repeated_late_tell_nothing_of_the_path(world):
    link = world.link(record=True, up=DELAY, down=DELAY)
    link.every(0.01, link.now + 3.0, lambda: link.publish(ROBOT, "scan", bytes(100)))
    repeated = []

    def attack():
        old = [p for at, p in link.sent[ROBOT] if 1.0 < at < link.now - 0.1 and p[0] == packet.DATA][-20:]
        repeated.extend(old)
        for one in old:
            link.inject(SERVICE, one, "elsewhere")

    link.every(0.1, link.now + 3.0, attack)
    before = link.sessions[SERVICE].stats(link.now).paths[0].packets_received
    sent = len(link.sent[ROBOT])
    link.run(4.0)
    stats = link.sessions[SERVICE].stats(link.now)
    assert stats.paths[0].packets_received - before <= len(link.sent[ROBOT]) - sent + 10
    assert stats.rejected == {"repeated": len(repeated)}
    assert stats.paths[0].address == "robot"


def test_false_shards_of_a_handshake_do_not_hold_it_up(world, topics):
    """HELLO of a large table takes several packets; one false shard of it was enough to lose them all."""
    many = [topics[0].__class__(f"topic{i}", "std_msgs/msg/String", topics[0].direction) for i in range(200)]
    link = world.link(
        connect=False, record=True, robot={"topics": many}, service={"topics": many}, up=LinkConditions(delay=0.05)
    )
    link.run(0.01)
    first = link.sent[ROBOT][0][1]
    assert packet.pull_header(first)[5] > len(first)  # several packets
    link.inject(SERVICE, first[: packet.SHARD_AT] + bytes(len(first) - packet.SHARD_AT), "elsewhere")
    link.run(0.3)
    assert link.sessions[SERVICE].stats(link.now).rejected == {"hello_forged": 1}
    assert link.sessions[ROBOT].stats(link.now).connected


def test_the_id_on_the_wire_is_another_after_each_handshake_and_the_old_one_ends(world):
    link = world.link(record=True, robot={"config": Config(old_keys=0.5)}, service={"config": Config(old_keys=0.5)})

    def ids(since, role=ROBOT):
        return {packet.pull_header(p)[1] for at, p in link.sent[role] if at >= since and p[0] & 15 != 1}

    (first,) = ids(0.0)
    assert ids(0.0, SERVICE) == {first}
    hellos = {packet.pull_header(p)[1] for _, p in link.sent[ROBOT] if p[0] == packet.HELLO}
    assert hellos == {link.sessions[ROBOT].session_id} != {first}
    link.replace(SERVICE, world.session(SERVICE, now=link.now))
    link.run(1.0)
    (second,) = ids(link.now - 0.2)
    assert second != first
    link.run(1.0)
    old = [p for _, p in link.sent[SERVICE] if packet.pull_header(p)[1] == first][-1]
    before = all_but_rejected(link, ROBOT)
    link.inject(ROBOT, old)
    assert all_but_rejected(link, ROBOT) == before
    assert link.sessions[ROBOT].stats(link.now).rejected["session"] == 1


def test_a_path_that_comes_back_goes_on_with_its_numbers(world):
    """A packet number is a nonce: never twice under the same keys."""
    link = world.link(record=True)
    for _ in range(2):
        link.add_path(1)
        link.run(0.5)
        link.sessions[ROBOT].close_path(1, link.now)
        link.run(0.1)
    numbers = [(h[8], h[9]) for h in (packet.pull_header(p) for _, p in link.sent[ROBOT]) if h[0] != packet.HELLO]
    assert len(set(numbers)) == len(numbers)
    assert sum(path == 1 for path, _ in numbers) > 8
