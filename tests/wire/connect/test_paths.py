"""Two ends that several paths join, in made-up time."""

from itertools import pairwise

import pytest

from skytether.testing.link import LinkConditions
from skytether.wire import Config, Direction, PathSwitched, PathUse, PeerMoved, Role, Topic

ROBOT, SERVICE = Role.ROBOT, Role.SERVICE
PERIOD = 0.01
CUT = LinkConditions(cut=True)
WIFI, MOBILE = LinkConditions(delay=0.005), LinkConditions(delay=0.03)

TOPICS = (
    Topic("safe", "t/msg/T", Direction.IN, priority=120, lifespan=0.5, depth=10, paths=PathUse.REDUNDANT),
    Topic("plain", "t/msg/T", Direction.IN, priority=110, lifespan=0.5, depth=10, delivery=0.5),
    Topic("camera", "t/msg/T", Direction.IN, priority=10, lifespan=1.0, depth=10),
    Topic("safe_out", "t/msg/T", Direction.OUT, priority=127, lifespan=0.5, depth=10, paths=PathUse.REDUNDANT),
    Topic("plain_out", "t/msg/T", Direction.OUT, priority=126, lifespan=0.5, depth=10, delivery=0.5),
)


@pytest.fixture
def two(world):
    """A link with two paths that both know of each other; path 0 is the better one."""

    def make(first=WIFI, second=MOBILE, *, config=None, cost=0, **options):
        ends = {"topics": TOPICS, "config": config}
        link = world.link(robot=ends, service=ends, up=first, down=first, **options)
        link.add_path(1, up=second, down=second, cost=cost)
        link.run(1.5)
        return link

    return make


def stream(link, topic, seconds, *, role=ROBOT, size=128, period=PERIOD):
    """Publish numbered messages; returns what tells their fate after the link ran."""
    numbers = iter(range(100_000))
    link.every(period, link.now + seconds, lambda: link.publish(role, topic, next(numbers).to_bytes(size, "big")))
    receiver = SERVICE if role is ROBOT else ROBOT

    def fate():
        got = [(t, int.from_bytes(m.payload, "big")) for t, m in link.messages[receiver] if m.topic == topic]
        times = [t for t, _ in got]
        missing = set(range(next(numbers))) - {n for _, n in got}
        return missing, max(b - a for a, b in pairwise(times))

    return fate


def path_of(link, role, index):
    return next(p for p in link.sessions[role].stats(link.now).paths if p.path == index)


def test_both_ends_know_both_paths_and_use_the_better_one(two):
    link = two()
    for role in Role:
        paths = link.sessions[role].stats(link.now).paths
        assert [(p.path, p.active, p.health) for p in paths] == [(0, True, "live"), (1, False, "live")]
        assert [p.rtt_p50 for p in paths] == pytest.approx([0.01, 0.06], rel=0.1)
    assert path_of(link, SERVICE, 1).address == "robot-1"
    sent = path_of(link, ROBOT, 1).packets_sent
    fate = stream(link, "plain", 1.0)
    link.run(1.1)
    assert fate()[0] == set()
    assert path_of(link, ROBOT, 1).packets_sent - sent < 60  # the other one is only kept warm


@pytest.mark.parametrize("gone", [0, 1])
@pytest.mark.parametrize(("topic", "role"), [("safe", ROBOT), ("safe_out", SERVICE)])
def test_losing_one_of_two_paths_loses_nothing_of_a_redundant_topic(two, gone, topic, role):
    link = two(second=LinkConditions(delay=0.007))
    fate = stream(link, topic, 1.5, role=role)
    link.at(link.now + 0.5, lambda: link.roads[gone].set(CUT))
    link.run(2.0)
    missing, gap = fate()
    assert missing == set()
    assert gap <= PERIOD + 0.003


@pytest.mark.parametrize(("topic", "role"), [("plain", ROBOT), ("plain_out", SERVICE)])
def test_a_broken_path_costs_the_others_its_detection(two, topic, role):
    link = two()
    fate = stream(link, topic, 2.0, role=role)
    link.at(link.now + 0.5, lambda: link.roads[0].set(CUT))
    link.run(2.5)
    missing, gap = fate()
    assert missing == set()  # sent again by the other path as soon as answers were missed
    assert gap < 0.25
    events = [e for _, e in link.events[role] if isinstance(e, PathSwitched)]
    assert events == [PathSwitched(1, "lost")]


@pytest.mark.slow
@pytest.mark.parametrize("way", [ROBOT, SERVICE])
def test_a_path_broken_one_way_only_is_found_out_by_who_sends(two, way):
    link = two()
    fates = [stream(link, "plain", 2.0), stream(link, "plain_out", 2.0, role=SERVICE)]
    link.at(link.now + 0.5, lambda: setattr(link.roads[0].models[way], "conditions", CUT))
    link.run(2.5)
    assert [f()[0] for f in fates] == [set(), set()]
    assert path_of(link, way, 1).active


@pytest.mark.slow
def test_a_large_message_under_way_ends_on_the_other_path(two):
    link = two(config=Config(rate_bps=5e6))
    fate = stream(link, "camera", 2.0, size=40_000, period=0.1)
    link.at(link.now + 0.93, lambda: link.roads[0].set(CUT))
    link.run(3.5)
    assert fate()[0] == set()


def test_a_planned_switch_is_made_before_the_break(two):
    """Mello, thesis, section 3.5: 128 bytes every 10 ms, another path in mid-stream, nothing lost, no gap."""
    link = two(second=LinkConditions(delay=0.008))
    up, down = stream(link, "plain", 3.0), stream(link, "plain_out", 3.0, role=SERVICE)
    link.at(link.now + 1.0, lambda: link.sessions[ROBOT].open_path(0, link.now, cost=200))
    link.at(link.now + 1.15, lambda: link.roads[0].set(CUT))
    link.run(3.5)
    for fate in (up, down):
        missing, gap = fate()
        assert missing == set()
        assert gap <= 2 * PERIOD
    for role in Role:
        assert [e for _, e in link.events[role] if isinstance(e, PathSwitched)] == [PathSwitched(1, "cheaper")]


@pytest.mark.slow
def test_a_cheaper_path_that_comes_back_is_used_again_once_it_is_stable(two):
    link = two(cost=10)
    link.roads[0].set(CUT)
    link.run(2.0)
    assert path_of(link, ROBOT, 1).active
    fate = stream(link, "plain", 8.0)
    link.roads[0].set(WIFI)
    back = link.now
    link.run(1.5)
    assert path_of(link, ROBOT, 1).active
    link.run(7.0)
    assert path_of(link, ROBOT, 0).active
    assert fate()[0] == set()
    switched = [t for t, e in link.events[ROBOT] if e == PathSwitched(0, "cheaper")]
    assert len(switched) == 1
    assert switched[0] - back >= Config().path_stable


@pytest.mark.slow
def test_a_much_worse_path_is_left_and_one_as_bad_is_not(two):
    link = two(first=LinkConditions(delay=0.03), second=LinkConditions(delay=0.032))
    link.run(10)
    assert not any(isinstance(e, PathSwitched) for _, e in link.events[ROBOT])
    link.roads[0].set(LinkConditions(delay=0.15))
    link.run(10)
    for role in Role:
        assert [e for _, e in link.events[role] if isinstance(e, PathSwitched)][-1:] == [PathSwitched(1, "better")]


@pytest.mark.slow
def test_losses_alone_make_no_path_flap(two):
    lossy = LinkConditions(delay=0.02, loss=0.05, seed=3)
    link = two(first=lossy, second=LinkConditions(delay=0.022, loss=0.05, seed=4))
    fate = stream(link, "plain", 20.0)
    link.run(21.0)
    switches = [e for _, e in link.events[ROBOT] if isinstance(e, PathSwitched)]
    assert len(switches) <= 1
    assert len(fate()[0]) < 0.06 * 2000  # those of the link


@pytest.mark.slow
def test_an_interface_that_vanishes_and_another_that_comes(two):
    link = two()
    safe, plain = stream(link, "safe", 3.0), stream(link, "plain", 3.0)
    link.at(link.now + 1.0, lambda: link.close_path(0))
    link.at(link.now + 2.0, lambda: link.add_path(2, up=WIFI, down=WIFI))
    link.run(4.0)
    assert safe()[0] == plain()[0] == set()
    assert {p.path for p in link.sessions[ROBOT].stats(link.now).paths} == {1, 2}
    assert next(e for _, e in link.events[ROBOT] if isinstance(e, PathSwitched)) == PathSwitched(1, "closed")
    link.run(12.0)
    assert {p.path for p in link.sessions[SERVICE].stats(link.now).paths} == {1, 2}  # the one left is forgotten


@pytest.mark.slow
def test_the_last_interface_goes_and_comes_back_as_another(two):
    link = two()
    link.close_path(0)
    link.close_path(1)
    link.run(3.0)
    link.add_path(5, up=WIFI, down=WIFI)
    link.run(1.0)
    fate = stream(link, "plain", 1.0)
    link.run(1.5)
    assert fate()[0] == set()
    assert link.sessions[ROBOT].stats(link.now).handshakes == 1


@pytest.mark.slow
def test_an_address_that_changes_in_mid_stream_loses_nothing_of_a_redundant_topic(two):
    link = two()
    up, down = stream(link, "safe", 2.0), stream(link, "safe_out", 2.0, role=SERVICE)
    moved_at = link.now + 1.005
    link.at(moved_at, lambda: link.addresses.__setitem__(ROBOT, "robot-moved"))
    link.run(2.5)
    for fate in (up, down):
        assert fate()[0] == set()
    first = min(t for t, m in link.messages[SERVICE] if t > moved_at)
    assert first - moved_at <= 2 * WIFI.delay + PERIOD
    assert any(e == PeerMoved("robot-moved") for _, e in link.events[SERVICE])
    assert path_of(link, SERVICE, 0).address == "robot-moved"


def test_a_false_path_number_opens_nothing(two):
    link = two(record=True)
    link.roads[0].set(CUT)
    link.publish(ROBOT, "plain", b"kept back")
    kept = link.sent[ROBOT][-1][1]
    forged = kept[:25] + bytes([7]) + kept[26:]
    link.inject(SERVICE, forged, "thief")
    assert {p.path for p in link.sessions[SERVICE].stats(link.now).paths} == {0, 1}
    assert all(p.address != "thief" for p in link.sessions[SERVICE].stats(link.now).paths)


@pytest.mark.slow
def test_more_paths_than_an_end_keeps(two):
    link = two()
    for path in range(2, 20):
        link.add_path(path, up=MOBILE, down=MOBILE)
        link.run(0.3)
    for role in Role:
        assert len(link.sessions[role].stats(link.now).paths) <= 8
    fate = stream(link, "plain", 1.0)
    link.run(1.5)
    assert fate()[0] == set()


def test_numbers_of_paths_and_costs_have_a_range(two):
    link = two()
    with pytest.raises(ValueError, match="0 to 255"):
        link.sessions[ROBOT].open_path(256, link.now)
    with pytest.raises(ValueError, match="0 to 255"):
        link.sessions[ROBOT].open_path(1, link.now, cost=-1)
