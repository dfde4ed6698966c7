"""When the robot's end speaks: until it is heard, after an outage, after a restart, to another place."""

import itertools

import pytest
from link_look import events, hellos

from skytether.emulator.link_model import LinkConditions
from skytether.wire import Connected, Disconnected, Role

ROBOT, SERVICE = Role.ROBOT, Role.SERVICE


def relay(link, first):
    first.handle_timer(link.now)
    for batch in first.transmit(link.now):
        link.inject(ROBOT, bytes(batch.data), "service", batch.segment)


def test_a_lost_handshake_is_repeated_quickly_at_first_and_with_back_off_later(world):
    link = world.link(connect=False, up=LinkConditions(cut=True), record=True)
    link.run(4.9)
    times = [t for t, p in link.sent[ROBOT]]
    waits = [b - a for a, b in itertools.pairwise(times)]
    assert waits[:20] == pytest.approx([0.05] * 20)
    assert waits[20:] == pytest.approx([0.05 * t for t in times[20:-1]])
    assert len(set(hellos(link))) == 1
    link.run(30.0)
    assert link.sent[ROBOT][-1][0] - link.sent[ROBOT][-2][0] == pytest.approx(1.0)
    before = len(set(hellos(link)))
    link.models[ROBOT].conditions = LinkConditions()
    link.run(2.0)
    assert 6 <= before <= len(set(hellos(link))) <= 9  # a new one before the service forgets the old one
    assert events(link, SERVICE, Connected)


@pytest.mark.parametrize(("burst", "most", "all_within"), [(None, 0.4, 1.0), (4, 1.0, 3.0)], ids=["single", "bursts"])
def test_thirty_percent_of_loss_costs_a_handshake_tenths_of_a_second(make_world, burst, most, all_within):
    """Bursts are of 4 packets here however far apart those are, so repeating costs more than on a real link."""
    took = []
    for seed in range(40):
        bad = {"delay": 0.05, "loss": 0.3, "burst": burst}
        up, down = LinkConditions(seed=2 * seed, **bad), LinkConditions(seed=2 * seed + 1, **bad)
        link = make_world(seed).link(connect=False, up=up, down=down)
        while not all(events(link, role, Connected) for role in Role):
            link.run(0.05)
            assert link.now < 10
        took.append(max(events(link, role, Connected)[0][0] for role in Role))
    took.sort()
    assert took[37] <= most
    assert took[-1] <= all_within


def test_a_robot_goes_on_confirming_until_the_service_is_heard(world):
    link = world.link(connect=False, up=LinkConditions(delay=0.01), down=LinkConditions(delay=0.01))
    link.run(0.015)
    link.models[ROBOT].conditions = LinkConditions(cut=True)
    link.run(0.4)
    assert events(link, ROBOT, Connected)
    assert not events(link, SERVICE, Connected)
    back = link.now
    link.models[ROBOT].conditions = LinkConditions(delay=0.01)
    link.run(0.1)
    assert events(link, SERVICE, Connected)[0][0] - back < 0.065


@pytest.mark.parametrize("role", list(Role))
@pytest.mark.parametrize("downtime", [0.05, 0.4, 3.0])
def test_a_restarted_end_is_rejoined_quickly(world, role, downtime):
    delay = LinkConditions(delay=0.002)
    link = world.link(up=delay, down=delay)
    link.every(0.01, link.now + downtime + 1, lambda: link.publish(ROBOT, "log", b"x"))
    dead = world.session(role, session_id=99)
    link.sessions[role] = dead  # deaf and dumb
    link.run(downtime)
    link.replace(role, world.session(role, now=link.now))
    up_at, before = link.now, len(link.messages[SERVICE])
    link.run(0.2)
    other = ROBOT if role is SERVICE else SERVICE
    assert events(link, role, Connected)[-1][0] - up_at < 0.2
    assert isinstance(link.events[other][-1][1], Connected)
    link.run(1.0)
    assert len(link.messages[SERVICE]) > before + 50
    silent = [e.reason for _, e in events(link, other, Disconnected)]
    assert silent == (["silent"] if downtime > 1 else [])


def test_an_outage_needs_no_new_handshake_and_loses_no_state(world):
    link = world.link()
    link.publish(ROBOT, "log", b"before")
    link.run(0.5)
    link.models[ROBOT].conditions = link.models[SERVICE].conditions = LinkConditions(cut=True)
    link.run(10.0)
    for role in Role:
        assert [e.reason for _, e in events(link, role, Disconnected)] == ["silent"]
    assert not link.publish(ROBOT, "log", b"nobody hears this")
    link.models[ROBOT].conditions = link.models[SERVICE].conditions = LinkConditions()
    back = link.now
    link.run(0.5)
    link.publish(ROBOT, "log", b"after")
    link.run(0.5)
    for role in Role:
        assert link.sessions[role].stats(0).handshakes == 1
        assert len(events(link, role, Connected)) == 2
    assert events(link, ROBOT, Connected)[1][0] - back <= 0.21  # 2 % of the silence
    assert [(m.payload, m.sequence) for _, m in link.messages[SERVICE]] == [(b"before", 0), (b"after", 1)]


def test_goodbye_ends_it_at_once_and_the_robot_keeps_trying(world):
    link = world.link()
    link.sessions[SERVICE].close(link.now)
    link.run(0.01)
    assert link.events[SERVICE][-1][1] == Disconnected("closed")
    assert link.events[ROBOT][-1][1] == Disconnected("goodbye")
    assert not link.publish(ROBOT, "log", b"x")
    link.run(3.0)
    link.replace(SERVICE, world.session(SERVICE, now=link.now))
    link.run(1.1)
    assert isinstance(link.events[ROBOT][-1][1], Connected)


def test_the_service_waits_after_a_robots_goodbye(world):
    link = world.link()
    link.sessions[ROBOT].close(link.now)
    link.run(5.0)
    assert link.events[SERVICE][-1][1] == Disconnected("goodbye")
    assert link.sessions[SERVICE].next_timer() is None
    link.replace(ROBOT, world.session(ROBOT, now=link.now))
    link.run(1.0)
    assert isinstance(link.events[SERVICE][-1][1], Connected)


def test_the_robot_speaks_to_another_address_when_told(world):
    link = world.link()
    first = link.sessions[SERVICE]
    link.addresses[SERVICE] = "elsewhere"
    link.sessions[SERVICE] = world.session(SERVICE, now=link.now)
    # The first service is still alive and still pings from the old address.
    link.every(0.05, link.now + 1, lambda: relay(link, first))
    link.sessions[ROBOT].set_peer("elsewhere")
    link.run(1.0)
    assert link.sessions[SERVICE].stats(link.now).connected
    assert link.sessions[ROBOT].stats(link.now).paths[0].address == "elsewhere"
