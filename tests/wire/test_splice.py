"""A stranger on the path puts packets together from what he saw: other handshakes, directions, messages, versions."""

from collections import Counter
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.emulator.link_model import LinkConditions
from skytether.wire import Config, Connected, Disconnected, Role
from skytether.wire.codec import crypto, packet

ROBOT, SERVICE = Role.ROBOT, Role.SERVICE
OTHER = {ROBOT: SERVICE, SERVICE: ROBOT}
DELAY = LinkConditions(delay=0.02)
NONCE = slice(packet.INDEX_AT, packet.HEADER_SIZE)
TAG = slice(packet.HEADER_SIZE, packet.SHARD_AT)


def put(data, part, source):
    """A packet with a part of another."""
    return data[: part.start] + source[part] + data[part.stop :]


def shards_of(packets):
    """Those with shards, of the size that most have."""
    shards = [p for p in packets if p[0] == packet.SHARD]
    ((size, _),) = Counter(len(p) for p in shards).most_common(1)
    return [p for p in shards if len(p) == size]


def state(link, role):
    """What none of it may change."""
    stats = link.sessions[role].stats(link.time_of(role))
    topics = [(t.topic, t.delivered, t.lost, t.late, t.duplicate, t.expired) for t in stats.topics]
    paths = [(p.address, p.packets_received, p.bytes_received, p.loss_in, p.packets_sent) for p in stats.paths]
    return topics, paths, stats.reassembly_bytes, stats.connected, stats.handshakes, len(link.events[role])


def address_of_peer(link, role):
    return link.sessions[role].stats(link.time_of(role)).paths[0].address


def refused(link, role):
    return Counter(link.sessions[role].stats(link.time_of(role)).rejected)


def kinds(link, role):
    return [type(event) for _, event in link.events[role]]


@pytest.fixture(scope="module")
def rekeyed(make_world):
    """Two handshakes whose keys are both good, and packets of each that never arrived, by id."""
    long = {"config": Config(old_keys=60.0)}
    link = make_world(5).link(record=True, robot=long, service=long)
    link.lost = {role: [] for role in Role}
    for turn in range(2):
        for road in link.roads.values():
            road.set(LinkConditions(cut=True))
        start = link.now
        for _ in range(3):
            link.publish(ROBOT, "scan", bytes(80))
            link.publish(ROBOT, "camera", bytes(9000))
            link.publish(SERVICE, "cmd_vel", bytes(80))
            link.publish(SERVICE, "map", bytes(9000))
            link.run(0.01)
        for role in Role:
            sent = [p for at, p in link.sent[role] if at >= start]
            link.lost[role].append([p for p in sent if p[0] in (packet.DATA, packet.SHARD)])
        for road in link.roads.values():
            road.set(LinkConditions())
        if turn == 0:
            link.sessions[ROBOT].rekey(link.now)
        link.run(0.3)
    for role in Role:
        first, second = link.lost[role]
        assert len({p[1:9] for p in first + second}) == 2
    return link


def test_what_an_end_sent_is_nothing_that_it_takes(rekeyed):
    """Both directions have the same id on the wire, and keys of their own."""
    for role in Role:
        before, counts = state(rekeyed, role), refused(rekeyed, role)
        returned = rekeyed.lost[role][1]
        for one in returned:
            rekeyed.inject(role, one, address_of_peer(rekeyed, role))
        assert state(rekeyed, role) == before
        assert refused(rekeyed, role) - counts == {"forged": len(returned)}


def test_packets_of_one_handshake_are_none_of_another(rekeyed):
    """Epoch and id of the packet say other keys than those that sealed it; batches as well as packets alone."""
    for role in Role:
        before, counts = state(rekeyed, role), refused(rekeyed, role)
        first, second = rekeyed.lost[OTHER[role]]
        tried = 0
        for mine, theirs in ((first, second), (second, first)):
            for name in (slice(1, 9), slice(9, 10), slice(1, 10)):
                changed = [put(one, name, theirs[0]) for one in mine]
                for one in changed:
                    rekeyed.inject(role, one, "elsewhere")
                equal = shards_of(changed)
                rekeyed.inject(role, b"".join(equal), "elsewhere", segment=len(equal[0]))
                tried += len(changed) + len(equal)
        assert state(rekeyed, role) == before
        assert refused(rekeyed, role) - counts == {"forged": tried}


@given(seed=st.integers(0, 2**32))
@settings(max_examples=20)
def test_parts_of_several_packets_make_none(rekeyed, seed):
    random = Random(seed)
    role = random.choice(list(Role))
    before = state(rekeyed, role)
    mine = rekeyed.lost[OTHER[role]][1]
    shards = shards_of(mine)
    whole = [p for p in mine if p[0] == packet.DATA]
    parts = (slice(0, packet.COMMON_SIZE), slice(packet.COMMON_SIZE, packet.INDEX_AT), NONCE, TAG,
             slice(packet.SHARD_AT, None), slice(26, 30), slice(30, 32), slice(10, 16))  # fmt: skip
    made = []
    for _ in range(10):
        one, other = random.sample(shards, 2)
        part = random.choice(parts)
        spliced = one[: part.start] + other[part] + (b"" if part.stop is None else one[part.stop :])
        made += [spliced] if spliced not in (one, other) else []
        one, other = random.choice(whole), random.choice(mine)
        made += [one[:at] + other[at:] for at in (1, 10, 22, 25, 32) if one[:at] + other[at:] not in (one, other)]
    for spliced in made:
        rekeyed.inject(role, spliced, "elsewhere")
    assert state(rekeyed, role) == before


def test_batches_of_shards_again_whole_reversed_and_in_part(world):
    link = world.link(record=True, up=DELAY, down=DELAY)
    link.publish(ROBOT, "camera", bytes(20_000))
    link.run(0.5)
    seen = shards_of([p for _, p in link.sent[ROBOT]])
    before, counts = state(link, SERVICE), refused(link, SERVICE)
    size = len(seen[0])
    for batch in (seen, seen[::-1], seen[3:9], seen[:4] * 3, sorted(seen)):
        link.inject(SERVICE, b"".join(batch), "elsewhere", segment=size)
        assert refused(link, SERVICE) - counts == {"repeated": len(batch)}
        counts = refused(link, SERVICE)
    assert state(link, SERVICE) == before


def test_handshakes_in_any_order_later_end_nothing_and_make_no_keys(world, monkeypatch):
    """All packets of six handshakes again, the last first, shuffled, from elsewhere and from the peer's address."""
    link = world.link(record=True, up=DELAY, down=DELAY)
    for _ in range(5):
        link.sessions[ROBOT].rekey(link.now)
        link.run(0.5)
    before = [link.sessions[role].stats(link.now).handshakes for role in Role]
    assert min(before) >= 5
    exchanged = []
    monkeypatch.setattr(crypto, "exchange", lambda *keys: exchanged.append(keys))
    for role, kind, reason in ((SERVICE, packet.HELLO, "hello_replayed"), (ROBOT, packet.WELCOME, "unasked")):
        seen = [p for _, p in link.sent[OTHER[role]] if p[0] == kind]
        shuffled = world.random.sample(seen, len(seen))
        counts, packets = refused(link, role), len(link.sent[role])
        for one in (*reversed(seen), *shuffled):
            for address in ("elsewhere", address_of_peer(link, role)):
                link.inject(role, one, address)
        assert refused(link, role) - counts == {reason: 4 * len(seen)}
        assert len(link.sent[role]) == packets  # no answer
    assert exchanged == []  # no X25519 for what was used up
    link.publish(ROBOT, "scan", b"x")
    link.publish(SERVICE, "cmd_vel", b"y")
    link.run(0.1)
    assert [link.sessions[role].stats(link.now).handshakes for role in Role] == before
    assert [bytes(link.messages[role][-1][1].payload) for role in (SERVICE, ROBOT)] == [b"x", b"y"]
    assert kinds(link, ROBOT) == kinds(link, SERVICE) == [Connected]


def test_questions_after_keys_of_then_make_no_keys_later(world, monkeypatch):
    """HELLOs of an outage, answered by a ping as the service still had the keys, again after the next handshake."""
    link = world.link(record=True, up=DELAY, down=DELAY)
    start = link.now
    link.roads[0].set(LinkConditions(cut=True))
    link.run(6.0)
    link.roads[0].set(DELAY)
    link.run(1.0)
    seen = [p for at, p in link.sent[ROBOT] if p[0] == packet.HELLO and at >= start]
    assert len(set(seen)) >= 2
    link.sessions[ROBOT].rekey(link.now)
    link.run(0.5)
    assert link.sessions[SERVICE].stats(link.now).handshakes == 2
    exchanged = []
    monkeypatch.setattr(crypto, "exchange", lambda *keys: exchanged.append(keys))
    counts, packets = refused(link, SERVICE), len(link.sent[SERVICE])
    for one in seen:
        link.inject(SERVICE, one, "elsewhere")
    assert refused(link, SERVICE) - counts == {"hello_replayed": len(seen)}
    assert len(link.sent[SERVICE]) == packets
    assert exchanged == []


@pytest.mark.parametrize("restarted", [False, True])
def test_hellos_that_no_service_heard_keep_no_robot_out(world, restarted):
    """Somebody kept them, of this life of the robot or of one before, and sends five while the robot is answered."""
    cut = LinkConditions(cut=True)
    link = world.link(connect=False, record=True, up=cut, down=cut)
    link.run(30.0)
    kept = list(dict.fromkeys(p for _, p in link.sent[ROBOT] if p[0] == packet.HELLO))[:5]
    if restarted:
        link.replace(ROBOT, world.session(ROBOT, now=link.now))
    link.roads[0].set(LinkConditions(delay=0.05))
    while not any(p[0] == packet.WELCOME for _, p in link.sent[SERVICE]):
        link.run(0.01)
    for one in kept:
        link.inject(SERVICE, one, "elsewhere")
    link.run(0.12)
    assert kinds(link, SERVICE) == [Connected]


def test_hellos_of_four_lives_that_no_service_heard_cost_a_robot_half_a_second_once(world):
    """Each of another life of the robot, all while it is answered: none of them has more than it."""
    cut, kept = LinkConditions(cut=True), []
    link = world.link(connect=False, record=True, up=cut, down=cut)
    for _ in range(4):
        link.run(1.0)
        kept.append([p for _, p in link.sent[ROBOT] if p[0] == packet.HELLO][-1])
        link.replace(ROBOT, world.session(ROBOT, now=link.now))
    link.roads[0].set(LinkConditions(delay=0.05))
    while not any(p[0] == packet.WELCOME for _, p in link.sent[SERVICE]):
        link.run(0.01)
    for one in kept:
        link.inject(SERVICE, one, "elsewhere")
    link.run(0.12)
    assert kinds(link, SERVICE) == []
    link.run(0.4)
    assert kinds(link, SERVICE) == [Connected]
    counts = refused(link, SERVICE)
    for one in kept:
        link.inject(SERVICE, one, "elsewhere")
    assert refused(link, SERVICE) - counts == {"hello_replayed": 4}


def test_an_old_welcome_answers_no_new_hello(world):
    """While the robot asks for new keys, all answers that it ever got come again, before the right one."""
    link = world.link(record=True, up=DELAY, down=DELAY)
    for _ in range(3):
        link.sessions[ROBOT].rekey(link.now)
        link.run(0.5)
    old = [p for _, p in link.sent[SERVICE] if p[0] == packet.WELCOME]
    start = link.now
    link.sessions[ROBOT].rekey(link.now)
    link.run(0.005)
    assert any(p[0] == packet.HELLO for at, p in link.sent[ROBOT] if at >= start)
    handshakes, counts = link.sessions[ROBOT].stats(link.now).handshakes, refused(link, ROBOT)
    for one in old:
        link.inject(ROBOT, one)
    assert refused(link, ROBOT) - counts == {"welcome_forged": len(old)}
    assert link.sessions[ROBOT].stats(link.now).handshakes == handshakes
    link.run(0.1)
    assert link.sessions[ROBOT].stats(link.now).handshakes == handshakes + 1


@pytest.mark.parametrize("role", Role)
def test_a_goodbye_of_another_time_ends_nothing(world, role):
    """The peer's own goodbye, recorded before it was restarted, and with the id of now."""
    link = world.link(record=True, robot={"config": Config(old_keys=0.3)}, service={"config": Config(old_keys=0.3)})
    peer = OTHER[role]
    said = len(link.sent[peer])
    link.sessions[peer].close(link.now)
    link.run(0.1)
    goodbyes = [p for _, p in link.sent[peer][said:]]
    assert goodbyes
    link.replace(peer, world.session(peer, now=link.now))
    if peer is ROBOT:
        link.sessions[ROBOT].set_peer("service")
    link.run(8.0)
    assert link.sessions[role].stats(link.now).connected
    ended = kinds(link, role).count(Disconnected)
    now = next(p for _, p in reversed(link.sent[peer]) if p[0] == packet.DATA)
    counts = refused(link, role)
    for one in goodbyes:
        link.inject(role, one)
        link.inject(role, put(one, slice(1, 10), now))
    link.run(0.5)
    assert kinds(link, role).count(Disconnected) == ended
    assert link.sessions[role].stats(link.now).connected
    assert refused(link, role) - counts == {"session": len(goodbyes), "forged": len(goodbyes)}


@pytest.mark.parametrize("version", [0, 1, 2, 15])
def test_no_packet_of_another_version_is_taken_or_answered(rekeyed, version):
    """A stranger cannot talk an end down to a protocol without tags: there is one version, and it is in the tag."""
    for role in Role:
        before, counts = state(rekeyed, role), refused(rekeyed, role)
        packets = [p for _, p in rekeyed.sent[OTHER[role]][:20]] + rekeyed.lost[OTHER[role]][1]
        for one in packets:
            rekeyed.inject(role, bytes([version << 4 | one[0] & 15]) + one[1:], "elsewhere")
        assert state(rekeyed, role) == before
        assert refused(rekeyed, role) - counts == {"version": len(packets)}


def test_an_authentic_packet_that_a_stranger_brings_sooner_takes_the_session_nowhere(world):
    """He is faster than the path and sends all that he sees from his own address. He sees, and gets copies; no more."""
    link = world.link(record=True, up=DELAY, down=DELAY)
    done = [len(link.sent[ROBOT])]

    def sooner():
        for _, one in link.sent[ROBOT][done[0] :]:
            link.inject(SERVICE, one, "elsewhere")
        done[0] = len(link.sent[ROBOT])

    sent = []

    def publish():
        sent.append(len(sent).to_bytes(4))
        link.publish(SERVICE, "cmd_vel", sent[-1])

    link.every(0.001, link.now + 3.0, sooner)
    link.every(0.05, link.now + 3.0, publish)
    link.run(4.0)
    assert [bytes(m.payload) for _, m in link.messages[ROBOT]] == sent
    assert link.sessions[SERVICE].stats(link.now).paths[0].address == "robot"
    assert kinds(link, SERVICE) == [Connected]
    assert set(refused(link, SERVICE)) == {"repeated"}  # the robot's own, which came second


def test_what_strangers_send_costs_no_key_exchange_and_no_opened_seal(rekeyed, monkeypatch):
    """Unknown ids end before any cipher; known ones at one tag; false handshakes at one keyed hash."""
    work = Counter()

    def counted(owner, name):
        whole = getattr(owner, name)

        def call(*args, **options):
            work[name] += 1
            return whole(*args, **options)

        monkeypatch.setattr(owner, name, call)

    for name in ("exchange", "derive", "open_once", "short_mac", "data_keys", "packet_id"):
        counted(crypto, name)
    counted(crypto.Aead, "open")
    seen = rekeyed.lost[ROBOT][1]
    shard = next(p for p in seen if p[0] == packet.SHARD)
    hello = next(p for _, p in rekeyed.sent[ROBOT] if p[0] == packet.HELLO)
    for one in seen:
        rekeyed.inject(SERVICE, one[:1] + bytes(8) + one[9:])
    assert not work
    rekeyed.inject(SERVICE, shard[:-1] + bytes([shard[-1] ^ 1]))
    assert not work  # a tag: no seal is opened
    for at in range(0, len(hello), 11):
        rekeyed.inject(SERVICE, hello[:at] + bytes([hello[at] ^ 4]) + hello[at + 1 :])
    assert set(work) <= {"short_mac"}
    assert work["short_mac"] <= len(hello) // 11 + 1
