"""One path: packet numbers, what the peer is told of them, copies for addresses that are to be proven."""

import math

import pytest

from skytether.wire import Config
from skytether.wire.codec.frames import MOST_ASTRAY, MOST_RUN, Feedback
from skytether.wire.codec.packet import ticks
from skytether.wire.path.pacer import BURST
from skytether.wire.path.path import ASTRAY_TIME, MUCH, MUCH_AT_FIRST, SETTLE, UNKNOWN, Path, Transmit
from skytether.wire.path.path_estimators import NUMBERS

CONFIG = Config(rate_bps=1e9)


@pytest.fixture
def path():
    return Path(3, CONFIG, 10.0)


def test_packet_numbers_are_claimed_in_runs_and_begin_anew(path):
    assert [path.number(), path.number(5), path.number()] == [0, 1, 6]
    assert path.packets_sent == 7
    path.next_number = NUMBERS - 2
    assert path.number(3) == NUMBERS - 2
    assert path.number() == 1


def test_packets_that_go_elsewhere_are_told_as_runs_for_a_while(path):
    path.number(10)
    assert [path.number_astray(10.0 + i / 100) for i in range(3)] == [10, 11, 12]
    path.number(5)
    assert path.number_astray(10.1) == 18
    assert path.astray(10.1) == ((10, 3), (18, 1))
    assert path.astray(10.05 + ASTRAY_TIME) == ((18, 1),)
    assert path.astray(20.0) == ()


def test_runs_are_as_long_and_as_many_as_a_ping_can_tell(path):
    for _ in range(MOST_RUN + 2):
        path.number_astray(10.0)
    assert path.astray(10.0) == ((0, MOST_RUN), (MOST_RUN, 2))
    for _ in range(2 * MOST_ASTRAY):
        path.number()
        path.number_astray(10.0)
    assert len(path.astray(10.0)) == MOST_ASTRAY


def arrive(path, numbers, now=10.0, size=1000):
    for number in numbers:
        path.comes(size, 1, now, 0.0)
        path.arrived(number, ticks(now), size)
        now += 0.002
    return now


def test_the_peer_is_told_what_was_lost(path):
    now = arrive(path, [n for n in range(100) if n not in (20, 50, 51)])
    path.feedback(now + SETTLE)
    now = arrive(path, range(100, 130), now + SETTLE)
    told = path.feedback(now + 2 * SETTLE)
    assert (told.lost, told.runs) == (3, 2)
    assert told.settled >= 100
    assert (path.packets_received, path.bytes_received) == (127, 127_000)
    assert 0.0 < path.loss_in.model.loss < 0.2


def test_of_much_the_peer_is_told_at_once_and_of_less_on_a_path_that_is_not_known_well(path):
    arrive(path, range(MUCH_AT_FIRST - 1))
    assert not path.much_arrived
    now = arrive(path, [MUCH_AT_FIRST])
    assert path.much_arrived
    for first in range(MUCH_AT_FIRST + 1, 2000, 100):
        path.feedback(now + SETTLE)
        now = arrive(path, range(first, first + 100), now + SETTLE)
    path.feedback(now + SETTLE)
    now = arrive(path, range(2100, 2100 + MUCH - 1), now + SETTLE)
    assert not path.much_arrived
    arrive(path, [2100 + MUCH], now)
    assert path.much_arrived


NOTHING = Feedback(math.inf, 0.0, 0.0, 0, 0, 0, 0.0, 0.0)


def test_more_parity_is_planned_once_the_peer_tells_of_losses(path):
    before = path.redundancy.parity(40, 1, 0.99)
    for turn in range(1, 30):
        lossy = NOTHING._replace(settled=1000 * turn, lost=200 * turn, runs=150 * turn, time=0.1 * turn)
        path.apply_feedback(lossy._replace(time_squared=0.001 * turn), 10.0 + 0.1 * turn)
    assert path.redundancy.parity(40, 1, 0.99) > before
    assert path.loss_out.model.loss == pytest.approx(0.2, abs=0.05)


def test_until_a_burst_was_answered_for_a_path_is_sent_on_with_caution(path):
    assert path.pacer.rate * 8 == max(UNKNOWN[0], CONFIG.rate_bps * UNKNOWN[1]) < CONFIG.rate_bps
    for turn in range(1, 10):
        path.apply_feedback(NOTHING, 10.0 + 0.1 * turn)
    assert path.pacer.rate * 8 <= CONFIG.rate_bps * UNKNOWN[1], "nothing was sent that could be answered for"
    path.rtts.add(0.02)
    path.pacer.budget(11.0)
    path.pacer.spend(BURST)
    for turn in range(1, 10):
        path.apply_feedback(NOTHING, 11.0 + 0.1 * turn)
    assert path.pacer.rate * 8 == path.control.rate > 2 * CONFIG.rate_bps * UNKNOWN[1]


def test_addresses_that_are_not_proven_get_copies_as_far_as_they_may(path):
    path.validation.packet_came("new", 100, 0.0, 10.0)
    batches = [Transmit(3, "old", bytes(250), None), Transmit(3, "old", bytes(100), 25)]
    copies = path.shared(batches)
    assert [(copy.address, len(copy.data), copy.segment) for copy in copies] == [("new", 250, None), ("new", 50, 25)]
    assert path.bytes_sent == 300
    assert path.shared(batches) == []


def test_a_copy_of_one_datagram_of_a_batch_is_no_batch(path):
    path.validation.packet_came("new", 10, 0.0, 10.0)
    ((_, address, data, segment),) = path.shared([Transmit(3, "old", bytes(100), 25)])
    assert (address, len(data), segment) == ("new", 25, None)


def test_another_peer_counts_anew_and_numbers_go_on(path):
    path.number(10)
    arrive(path, range(50))
    path.newest, path.echo = 49, (1.0, 10.0)
    path.validation.packet_came("new", 100, 0.0, 10.0)
    path.start_epoch(20.0)
    assert (path.newest, path.echo, len(path.validation)) == (-1, None, 0)
    assert path.feedback(21.0).settled == 0
    assert path.number() == 10
    assert path.ping_at == 20.0
