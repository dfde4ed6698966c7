"""Reliable topics between two sessions over made-up links: everything once, in order, whatever the link does."""

from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.lab.link_model import LinkConditions
from skytether.wire import Direction, Role, Topic

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


@given(
    up=conditions, down=conditions, outages=st.lists(st.tuples(st.floats(0, 3), st.floats(0.05, 2.5)), max_size=3),
    seed=st.integers(0, 2**32), new_keys=st.booleans(),
)  # fmt: skip
@settings(max_examples=15)
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
        assert link.sessions[role]._streams._busy == set()
