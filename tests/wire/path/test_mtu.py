"""The largest datagram that passes: found with made-up probes, and by sessions over a made-up link."""

from random import Random

import pytest

from skytether.testing.link import LinkConditions
from skytether.wire import Config, Role
from skytether.wire.path.mtu import CONFIRM_INTERVAL, SMALL, MtuSearch


def search(mtu, path, seconds, *, loss=0.0, seed=1, start=0.0, busy=True):
    """Let time pass over a path of that size; returns bytes probed."""
    random, now, probed = Random(seed), start, 0
    while mtu.due <= start + seconds:
        now = max(now, mtu.due)
        sizes = mtu.probe(now, 0.1, busy)
        for size in sizes:
            probed += size
            if size <= path and random.random() >= loss:
                mtu.answer(size)
    return probed


@pytest.mark.parametrize("loss", [0.0, 0.1, 0.5])
@pytest.mark.parametrize(
    ("path", "found"), [(1500, 1400), (1350, 1300), (1200, 1200), (1199, 1000), (700, 600), (512, 512)]
)
def test_what_passes_is_found(path, found, loss):
    mtu = MtuSearch(1200, 1400)
    mtu.restart(0.0)
    search(mtu, path, 30, loss=loss)
    assert mtu.size == found


def test_loss_alone_is_no_smaller_path():
    for seed in range(50):
        mtu = MtuSearch(1200, 1400)
        mtu.restart(0.0)
        search(mtu, 1500, 120, loss=0.5, seed=seed)
        assert mtu.size == 1400


def test_a_path_that_gets_smaller_is_noticed_soon_and_one_that_grows_later():
    mtu = MtuSearch(1200, 1400)
    mtu.restart(0.0)
    search(mtu, 1500, 10)
    assert mtu.size == 1400
    search(mtu, 900, CONFIRM_INTERVAL + 1.5, start=10)
    assert mtu.size == 800
    search(mtu, 1500, 5, start=15)
    assert mtu.size == 800
    search(mtu, 1500, 120, start=20)
    assert mtu.size == 1400


def test_nothing_is_asked_while_nothing_large_is_sent():
    mtu = MtuSearch(1200, 1400)
    mtu.restart(0.0)
    search(mtu, 1500, 5)
    assert search(mtu, 1500, 20, start=5, busy=False) == 0
    assert search(mtu, 1500, 20, start=25) < 25 * 1400


def test_what_the_system_refuses_is_not_sent_again():
    mtu = MtuSearch(1200, 1400)
    mtu.restart(0.0)
    mtu.refuse(1400, 0.0)  # a probe
    assert mtu.size == 1200
    search(mtu, 1350, 5)
    assert mtu.size == 1300
    mtu.refuse(1300, 6.0)
    assert mtu.size == 1200
    mtu.refuse(1200, 6.0)
    assert mtu.size == 1000
    search(mtu, 1100, 5, start=6)
    assert mtu.size == 1000


def test_an_answer_that_nobody_asked_for_changes_nothing():
    mtu = MtuSearch(1200, 1400)
    mtu.answer(9000)
    mtu.restart(0.0)
    mtu.probe(0.0, 0.1, True)
    mtu.answer(8952)
    mtu.answer(SMALL)
    assert mtu.size == 1200


@pytest.mark.parametrize(("path", "found"), [(1472, 1400), (1000, 1000), (576, 512)])
def test_large_messages_pass_any_path_soon(world, path, found):
    delay = LinkConditions(delay=0.03)
    link = world.link(up=delay, down=delay, mtu=path)
    link.run(2.0)
    assert [link.sessions[role].stats(link.now).paths[0].mtu for role in Role] == [found, found]
    link.publish(Role.ROBOT, "camera", bytes(40_000))
    link.publish(Role.SERVICE, "map", bytes(40_000))
    dropped = dict(link.dropped)
    link.run(0.5)
    assert [len(link.messages[role]) for role in Role] == [1, 1]
    assert all(link.dropped[role] == dropped.get(role, 0) for role in Role)


def test_a_stream_over_a_path_that_gets_smaller_goes_on(world):
    link = world.link(up=LinkConditions(delay=0.02), down=LinkConditions(delay=0.02))
    link.every(0.1, link.now + 10, lambda: link.publish(Role.ROBOT, "camera", bytes(20_000)))
    link.run(2.0)
    link.roads[0].mtu = 900
    shrunk = link.now
    link.run(8.5)
    times = [t for t, _ in link.messages[Role.SERVICE]]
    after = [t for t in times if t > shrunk + 3.0]
    assert len(after) >= 49
    assert link.sessions[Role.ROBOT].stats(link.now).paths[0].mtu == 800


def test_what_the_system_refuses_shrinks_the_next_message_at_once(world):
    link = world.link(record=True, robot={"config": Config(rate_bps=1e9)})
    link.sessions[Role.ROBOT].shrink(0, 1400, link.now)
    link.sent[Role.ROBOT].clear()
    link.publish(Role.ROBOT, "camera", bytes(20_000))
    sizes = {len(p) for _, p in link.sent[Role.ROBOT]}
    assert max(sizes) <= 1300
