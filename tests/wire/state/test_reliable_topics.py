"""Reliable topics between two sessions over made-up links: everything once, in order, whatever the link does."""

import tracemalloc

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.emulator.link_model import LinkConditions
from skytether.wire import Config, Connected, Direction, Role, Topic
from skytether.wire.events import MessageReceived

ROBOT, SERVICE = Role.ROBOT, Role.SERVICE
TOPICS = (
    Topic("goal", "a/b", Direction.IN, priority=90, lifespan=60.0, depth=1000, reliable=True),
    Topic("cmd_vel", "a/b", Direction.OUT, priority=127, lifespan=0.1, delivery=0.999),
    Topic("map", "a/b", Direction.OUT, priority=1, lifespan=60.0, depth=100, reliable=True),
    Topic("param", "a/b", Direction.OUT, priority=60, lifespan=60.0, reliable=True, latched=True),
)


def received(link, role, topic):
    return [bytes(m.payload) for _, m in link.messages[role] if m.topic == topic]


def row(link, role, topic):
    return next(t for t in link.sessions[role].stats(link.time_of(role)).topics if t.topic == topic)


def make(world, **options):
    ends = {"topics": TOPICS, **options.pop("ends", {})}
    return world.link(robot=ends, service=ends, **options)


conditions = st.builds(
    LinkConditions,
    delay=st.sampled_from([0.0, 0.005, 0.1]),
    jitter=st.sampled_from([0.0, 0.03]),
    loss=st.sampled_from([0.0, 0.02, 0.2, 0.45]),
    burst=st.sampled_from([None, 4]),
    rate=st.sampled_from([None, 10e6]),
    reorder=st.sampled_from([0.0, 0.2]),
    duplicate=st.sampled_from([0.0, 0.2]),
    seed=st.integers(0, 2**32),
)


@pytest.mark.slow
@given(
    up=conditions, down=conditions, outages=st.lists(st.tuples(st.floats(0, 3), st.floats(0.05, 2.5)), max_size=3),
    seed=st.integers(0, 2**32), new_keys=st.booleans(),
)  # fmt: skip
@settings(max_examples=8)
def test_everything_arrives_once_and_in_order_on_any_link(make_world, up, down, outages, seed, new_keys):
    world = make_world(seed)
    link = make(world, connect=False, up=up, down=down, seed=seed)
    published = {"goal": [], "map": []}

    def publish(role, topic, size):
        payload = world.random.randbytes(world.random.choice((0, 10, size)))
        assert link.publish(role, topic, payload)
        published[topic].append(payload)

    def cut(on):
        for role, good in ((ROBOT, up), (SERVICE, down)):
            link.models[role].conditions = LinkConditions(cut=True) if on else good

    link.every(0.05, 3.0, lambda: publish(ROBOT, "goal", 3000))
    link.every(0.4, 3.0, lambda: publish(SERVICE, "map", 120_000))
    for at, length in outages:
        link.at(at, lambda: cut(True))
        link.at(at + length, lambda: cut(False))
    if new_keys:  # the same ends shake hands anew
        link.at(1.7, lambda: link.sessions[ROBOT].set_peer("service"))
    link.run(40)
    assert received(link, SERVICE, "goal") == published["goal"]
    assert received(link, ROBOT, "map") == published["map"]
    for role in Role:
        for name in published:
            counted = row(link, role, name)
            assert (counted.lost, counted.expired, counted.replaced) == (0, 0, 0)
    sent = {role: link.sessions[role].stats(link.now) for role in Role}
    link.run(5)  # nothing is left to be said
    for role, before in sent.items():
        after = link.sessions[role].stats(link.now)
        assert [(t.bytes_sent, t.retransmitted) for t in after.topics] == [
            (t.bytes_sent, t.retransmitted) for t in before.topics
        ]


@pytest.mark.slow
def test_a_latched_value_published_before_there_was_a_session_is_kept(world):
    link = make(world, connect=False, up=LinkConditions(cut=True), down=LinkConditions(cut=True))
    assert link.publish(SERVICE, "param", b"old")
    assert link.publish(SERVICE, "param", b"new")
    link.run(70)  # longer than its lifespan
    link.models[ROBOT].conditions = link.models[SERVICE].conditions = LinkConditions()
    link.run(3)
    assert received(link, ROBOT, "param") == [b"new"]
    link.run(60)
    assert received(link, ROBOT, "param") == [b"new"]


def test_a_restarted_peer_gets_the_latched_value_and_what_was_not_acknowledged(world):
    link = make(world)
    link.publish(SERVICE, "param", b"p")
    link.publish(SERVICE, "map", b"acknowledged")
    link.run(1)
    link.models[SERVICE].conditions = LinkConditions(cut=True)
    link.publish(SERVICE, "map", b"1")
    link.publish(SERVICE, "map", bytes(5000))
    link.run(0.5)
    link.models[SERVICE].conditions = LinkConditions()
    link.messages[ROBOT].clear()
    link.replace(ROBOT, world.session(ROBOT, topics=TOPICS, now=link.now))
    link.run(2)
    assert received(link, ROBOT, "param") == [b"p"]
    assert received(link, ROBOT, "map") == [b"1", bytes(5000)]
    assert [e.restarted for _, e in link.events[SERVICE] if isinstance(e, Connected)] == [False, True]
    assert row(link, ROBOT, "map").lost == 0


def test_what_expired_is_lost_and_holds_nothing_up(world):
    topics = (Topic("goal", "a/b", Direction.IN, lifespan=0.5, depth=10, reliable=True),)
    link = make(world, ends={"topics": topics})
    link.publish(ROBOT, "goal", b"1")
    link.run(0.3)
    link.models[ROBOT].conditions = LinkConditions(cut=True)
    link.publish(ROBOT, "goal", b"2")
    link.run(1.0)
    link.models[ROBOT].conditions = LinkConditions()
    link.publish(ROBOT, "goal", b"3")
    link.run(1.0)
    assert received(link, SERVICE, "goal") == [b"1", b"3"]
    link.run(2)
    counted = row(link, SERVICE, "goal")
    assert (counted.sent, counted.delivered, counted.lost, counted.expired) == (3, 2, 1, 1)


def test_depth_bounds_what_is_not_acknowledged(world):
    topics = (
        Topic("state", "a/b", Direction.IN, lifespan=9.0, reliable=True),
        Topic("event", "a/b", Direction.IN, lifespan=9.0, depth=3, reliable=True),
    )
    link = make(world, ends={"topics": topics})
    link.models[SERVICE].conditions = LinkConditions(cut=True)  # no acknowledgements
    accepted = []
    for i in range(5):
        assert link.publish(ROBOT, "state", b"%d" % i)
        accepted.append(link.publish(ROBOT, "event", b"%d" % i))
    assert accepted == [True, True, True, False, False]
    link.models[SERVICE].conditions = LinkConditions()
    link.run(3)
    assert received(link, SERVICE, "state") == [b"0", b"4"]
    assert received(link, SERVICE, "event") == [b"0", b"1", b"2"]
    assert row(link, ROBOT, "state").replaced == 3
    assert row(link, ROBOT, "event").replaced == 2


def test_memory_of_the_sender_is_bounded(world):
    config = Config(queue_limit=2**20, max_message=2**20)
    topics = (Topic("event", "a/b", Direction.IN, lifespan=60.0, depth=10_000, reliable=True),)
    link = make(world, ends={"topics": topics, "config": config})
    link.models[SERVICE].conditions = LinkConditions(cut=True)
    accepted = sum(link.publish(ROBOT, "event", bytes(10_000)) for _ in range(500))
    assert accepted == 2**20 // 10_000
    link.models[SERVICE].conditions = LinkConditions()
    link.run(10)
    assert received(link, SERVICE, "event") == [bytes(10_000)] * accepted
    assert sum(link.publish(ROBOT, "event", bytes(10_000)) for _ in range(500)) == accepted


@pytest.mark.slow
@pytest.mark.parametrize("size", [4 * 2**20, pytest.param(16 * 2**20, marks=pytest.mark.slow)])
def test_a_large_map_over_a_bad_link_hurts_no_velocity_command(make_world, size):
    bad = LinkConditions(delay=0.05, loss=0.05)
    delays = []
    for payload in (b"", make_world(1).random.randbytes(size)):
        link = make(make_world(2), up=bad, down=bad, connect=False, ends={"config": Config(rate_bps=20e6)})
        link.run(2)
        link.every(0.01, link.now + 8, lambda link=link: link.publish(SERVICE, "cmd_vel", bytes(80)))
        if payload:
            link.publish(SERVICE, "map", payload)
        link.run(10)
        delays.append(row(link, ROBOT, "cmd_vel").delay_p99)
        assert received(link, ROBOT, "map") == ([payload] if payload else [])
        assert row(link, ROBOT, "cmd_vel").delivered + row(link, ROBOT, "cmd_vel").superseded > 790
    counted = row(link, SERVICE, "map")
    assert delays[1] < delays[0] + 0.001
    assert counted.bytes_sent < 1.1 * size  # 5 % sent again, headers 2.6 %


def test_compression_shrinks_what_can_be_shrunk(world):
    topics = tuple(
        Topic(name, "a/b", Direction.IN, lifespan=5.0, depth=9, reliable=reliable, compression=compression)
        for name, reliable, compression in (("a", True, "zstd"), ("b", False, "zstd"), ("c", False, ""))
    )
    link = make(world, ends={"topics": topics})
    easy, hard = bytes(100_000), world.random.randbytes(100_000)
    for name in "abc":
        link.publish(ROBOT, name, easy)
        link.publish(ROBOT, name, hard)
        link.publish(ROBOT, name, b"")
    link.run(2)
    for name in "abc":
        assert sorted(received(link, SERVICE, name)) == sorted([easy, hard, b""])
        counted = row(link, SERVICE, name)
        assert counted.bytes_delivered == 200_000
        assert (counted.bytes_sent < 140_000) == (name != "c")


def test_what_expands_beyond_the_largest_message_is_refused(world):
    topics = (Topic("a", "a/b", Direction.IN, lifespan=5.0, depth=9, compression="zstd"),)
    link = world.link(robot={"topics": topics}, service={"topics": topics, "config": Config(max_message=50_000)})
    link.publish(ROBOT, "a", bytes(50_001))
    link.publish(ROBOT, "a", bytes(50_000))
    link.run(1)
    assert received(link, SERVICE, "a") == [bytes(50_000)]
    assert link.sessions[SERVICE].stats(link.now).rejected == {"compressed": 1}


@pytest.mark.parametrize("reliable", [True, False])
def test_messages_that_grow_are_in_memory_one_at_a_time(world, reliable):
    options = {"lifespan": 5.0, "depth": 99, "reliable": reliable, "compression": "zstd"}
    topics = (Topic("a", "a/b", Direction.IN, **options),)
    link = make(world, ends={"topics": topics})
    link.run(1)
    robot, service = link.sessions[ROBOT], link.sessions[SERVICE]
    for _ in range(50):
        robot.publish("a", bytes(1_000_000), link.now)
    packets = []
    while batches := robot.transmit(link.now):
        for batch in batches:
            step = batch.segment or len(batch.data)
            packets += [bytes(batch.data[at : at + step]) for at in range(0, len(batch.data), step)]
    tracemalloc.start()
    for packet in reversed(packets):  # what is reliable waits for the first, and comes at once with it
        service.receive(packet, link.addresses[ROBOT], link.time_of(SERVICE))
    count = 0
    while (event := service.next_event()) is not None:
        count += isinstance(event, MessageReceived) and len(event.payload) == 1_000_000
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert count > 20
    assert peak < 5_000_000


def test_a_goodbye_that_leaves_an_acknowledgement_owed_leaves_nothing_due(world):
    link = make(world)
    service = link.sessions[SERVICE]
    assert link.publish(ROBOT, "goal", b"last words")
    link.at(link.now, lambda: link.sessions[ROBOT].close(link.time_of(ROBOT)))
    link.run(0.5)
    assert received(link, SERVICE, "goal") == [b"last words"]
    assert not service.stats(link.time_of(SERVICE)).connected
    due = service.next_timer()
    assert due is None or due > link.time_of(SERVICE)
