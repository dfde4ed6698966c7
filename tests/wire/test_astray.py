"""What an end sends to an address that somebody else made it try: packets of the path that its peer never gets."""

from functools import partial

import pytest

from skytether.emulator.link_model import LinkConditions
from skytether.wire import Direction, PeerMoved, Role, Topic
from skytether.wire.codec import packet

ROBOT, SERVICE = Role.ROBOT, Role.SERVICE
DELAY = LinkConditions(delay=0.02)
TOPICS = (
    Topic("up", "t/msg/T", Direction.IN, priority=100, lifespan=0.5, depth=10),
    Topic("down", "t/msg/T", Direction.OUT, priority=100, lifespan=0.5, depth=10),
)


@pytest.fixture
def link(world):
    """Two ends with traffic both ways at 50 Hz, from now on for 10 s."""
    ends = {"topics": TOPICS}
    link = world.link(robot=ends, service=ends, up=DELAY, down=DELAY, record=True)
    link.run(0.5)
    for role, topic in ((ROBOT, "up"), (SERVICE, "down")):
        link.every(0.02, link.now + 10.0, partial(link.publish, role, topic, bytes(100)))
    return link


def losses(link):
    """Shares of packets that each end believes to be lost, as it says of what it sends and of what it gets."""
    paths = [session.stats(link.now).paths[0] for session in link.sessions.values()]
    return [round(loss, 3) for path in paths for loss in (path.loss_out, path.loss_in)]


def moves(link):
    return [event for role in Role for event, _ in link.events[role] if isinstance(event, PeerMoved)]


@pytest.mark.parametrize("role", Role)
@pytest.mark.parametrize("addresses", [1, 1000])
def test_who_is_faster_than_the_path_makes_nobody_believe_in_loss(link, role, addresses):
    """Each packet of one end reaches the other first from elsewhere, and so the other asks who is there."""
    other = SERVICE if role is ROBOT else ROBOT
    seen = len(link.sent[role])
    for turn in range(1000):
        link.run(0.005)
        for _, one in link.sent[role][seen:]:
            link.inject(other, one, f"elsewhere {turn % addresses}")
        seen = len(link.sent[role])
    assert max(losses(link)) < 0.01
    assert moves(link) == []


def test_who_repeats_a_question_after_the_keys_makes_nobody_believe_in_loss(link):
    """A HELLO of a robot that asks whether the keys are still known; nothing has to be faster for that."""
    start = link.now
    link.roads[0].set(LinkConditions(cut=True))
    link.run(1.0)
    link.roads[0].set(DELAY)
    link.run(0.5)
    question = [one for at, one in link.sent[ROBOT] if one[0] == packet.HELLO and at >= start][-1]
    link.run(3.0)
    before = max(losses(link))  # of the outage: they are forgotten slowly
    for _ in range(600):
        link.run(0.005)
        link.inject(SERVICE, question, "elsewhere")
    assert max(losses(link)) <= before
    assert moves(link) == []


def test_real_losses_are_seen_as_they_are_meanwhile(link):
    """Nobody hides them by having packets sent elsewhere."""
    link.roads[0].models[SERVICE].conditions = LinkConditions(delay=0.02, loss=0.2, seed=3)
    seen = len(link.sent[ROBOT])
    for _ in range(1800):
        link.run(0.005)
        for _, one in link.sent[ROBOT][seen:]:
            link.inject(SERVICE, one, "elsewhere")
        seen = len(link.sent[ROBOT])
    assert link.sessions[SERVICE].stats(link.now).paths[0].loss_out == pytest.approx(0.2, abs=0.06)
    assert link.sessions[ROBOT].stats(link.now).paths[0].loss_in == pytest.approx(0.2, abs=0.06)
