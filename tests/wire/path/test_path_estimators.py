"""Losses and bursts from packet numbers; queue and capacity from delays."""

import math
from array import array
from random import Random

import pytest
from deep_size import deep_size

from skytether.emulator.link_model import LinkConditions, LinkModel
from skytether.wire.codec.frames import MOST_RUN
from skytether.wire.codec.packet import TICK, TICKS, ticks
from skytether.wire.config import Config
from skytether.wire.path.path import Path
from skytether.wire.path.path_estimators import COLLECT, NUMBERS, DelayMeter, LossMeter


def feed(meter, numbers, every=200, period=0.01):
    for i, number in enumerate(numbers):
        meter.add(number % NUMBERS, ticks(number % NUMBERS * period))
        if i % every == every - 1:
            meter.evaluate()
    meter.evaluate()
    meter.evaluate()


@pytest.mark.parametrize("start", [0, 1000, NUMBERS - 2000])
@pytest.mark.parametrize("reorder", [0, 30])
def test_share_and_runs_are_what_was_dropped(start, reorder):
    random, lost, runs, kept, inside = Random(3), 0, 0, [], False
    total = 4000
    for number in range(total):
        if number not in (0, total - 1) and random.random() < (0.7 if inside else 0.02):
            lost, runs, inside = lost + 1, runs + (not inside), True
        else:
            inside = False
            kept.append(start + number)
    kept.sort(key=lambda n: n + random.random() * reorder)
    meter = LossMeter()
    feed(meter, kept)
    assert meter.settled >= total - 2
    assert meter.lost == pytest.approx(lost, abs=2)
    assert meter.runs == pytest.approx(runs, rel=0.01)


@pytest.mark.parametrize("every", [1, 3, 100])
def test_a_run_is_one_run_with_its_duration_wherever_it_is_evaluated(every):
    meter = LossMeter()
    feed(meter, [n for n in range(300) if n % 50 not in (10, 11, 12, 13, 14)], every)
    assert (meter.lost, meter.runs) == (30, 6)
    if every == 100:  # those within one evaluation: five packets, 10 ms apart
        assert meter.time == pytest.approx(6 * 0.04, abs=0.045)
        assert meter.time_squared == pytest.approx(meter.time * 0.04, rel=0.01)


def test_reordering_alone_is_not_loss():
    numbers = list(range(3000))
    random = Random(4)
    numbers.sort(key=lambda n: n + random.random() * 100)
    meter = LossMeter()
    feed(meter, numbers)
    assert (meter.lost, meter.runs, meter.time) == (0, 0, 0.0)


def test_false_numbers_far_away_change_nothing():
    meter = LossMeter()
    numbers = []
    for n in range(2000):
        numbers += [n] if n % 10 else [n, n + 10_000_000]
    feed(meter, numbers)
    assert meter.lost == 0


@pytest.mark.parametrize("start", [0, 1000, NUMBERS - 2000])
@pytest.mark.parametrize("every", [1, 7, 200])
def test_what_was_sent_elsewhere_is_neither_here_nor_lost(start, every):
    """Of each ten numbers three went elsewhere, in runs; of each hundred that did not, five in a row are lost."""
    meter, plain = LossMeter(), LossMeter()
    here = [n for n in range(4000) if n % 10 not in (2, 3, 6)]
    kept = [n for i, n in enumerate(here) if i % 100 not in range(10, 15)]
    for at, number in enumerate(kept):
        meter.add((start + number) % NUMBERS, ticks(number * 0.01))
        tens = range(number // 10 * 10 - 20, number // 10 * 10 + 10, 10)
        meter.leave_out([((start + n + at) % NUMBERS, count) for n in tens for at, count in ((2, 2), (6, 1))])
        if at % every == 0:
            meter.evaluate()
    meter.evaluate()
    meter.evaluate()
    feed(plain, [start + i for i in range(len(here)) if i % 100 not in range(10, 15)], every)
    assert (meter.settled, meter.lost) == (plain.settled, plain.lost)
    assert meter.runs == plain.runs


def test_what_was_sent_elsewhere_is_forgotten_in_time_and_bounded():
    meter = LossMeter()
    for n in range(5000):
        meter.add(n, ticks(n * 0.01))
        meter.leave_out([(n + 2**31, 1), (n * 7, MOST_RUN)])
        if n % 50 == 0:
            meter.evaluate()
    assert deep_size(meter) < 50_000
    assert meter.lost == 0


def test_after_a_long_silence_it_begins_again():
    meter = LossMeter()
    feed(meter, [*range(1000), *range(50_000_000, 50_001_000)])
    assert meter.lost == 0


def test_a_flood_is_bounded_and_batches_count_like_packets():
    meter, other = LossMeter(), LossMeter()
    numbers = [n for n in range(200_000) if n % 7]
    for start in range(0, len(numbers), 50):
        some = numbers[start : start + 50]
        meter.add_all(array("I", some).tobytes(), array("H", [0] * len(some)).tobytes())
        for n in some:
            other.add(n, 0)
        assert deep_size(meter) < 50 * COLLECT
    meter.evaluate()
    other.evaluate()
    assert meter.lost / meter.settled == pytest.approx(1 / 7, abs=1e-3)
    assert other.lost == pytest.approx(meter.lost, abs=10)  # evaluated at other moments


def test_packet_numbers_wrap():
    path = Path(0, Config(), 0.0)
    path.next_number = NUMBERS - 2
    assert path.number(3) == NUMBERS - 2
    assert path.number() == 1
    assert path.packets_sent == 4


class Line:
    """Packets of a camera and of a fast small topic through a modelled link into a meter."""

    def __init__(self, conditions, offset=0.0):
        self.model = LinkModel(conditions, "up")
        self.meter = DelayMeter()
        self.offset = offset
        """Of the sender's clock."""
        self.now = 0.0
        self.number = 0

    def run(self, seconds, frame=47_611, rate=50e6, period=1 / 15, small=180):
        end, events = self.now + seconds, []
        sends = [(self.now + 0.01 * i, small) for i in range(round(seconds / 0.01))]
        for i in range(round(seconds / period)):
            gap = 1200 * 8 / rate
            sends += [(self.now + i * period + j * gap, 1200) for j in range(frame // 1168)]
        for sent, size in sorted(sends):
            events += [(arrival, self.number, sent, size) for arrival in self.model.decide(size, sent)]
            self.number += 1
        at = self.now
        for arrival, number, sent, size in sorted(events):
            while arrival > at + 0.1:
                at += 0.1
                self.meter.evaluate(at)
            self.meter.add(number, ticks(sent + self.offset), size, arrival)
        self.meter.evaluate(end)
        self.now = end


@pytest.mark.parametrize("capacity", [5e6, 20e6, 40e6])
def test_the_first_burst_tells_the_capacity(capacity):
    line = Line(LinkConditions(delay=0.03, rate=capacity), offset=1e6)
    line.run(0.2)
    # Of IP packets, of which headers are not counted; rates considered are 12 % apart.
    assert line.meter.capacity == pytest.approx(capacity * 1200 / 1228, rel=0.13)


@pytest.mark.parametrize("capacity", [5e6, 20e6])
def test_what_is_sent_at_once_is_known_by_its_numbers(capacity):
    # All of a frame has the same time of sending, so only its packets' numbers say what waited for what.
    line = Line(LinkConditions(delay=0.03, rate=capacity))
    line.run(0.2, rate=1e12)
    assert line.meter.capacity == pytest.approx(capacity * 1200 / 1228, rel=0.13)


def pauses(line, period, length):
    """A machine on the way that stands still for so long, that often."""
    decide = line.model.decide

    def late(size, now):
        return tuple(max(a, a // period * period + length) for a in decide(size, now))

    line.model.decide = late


def test_a_machine_that_pauses_is_no_slow_link():
    for length in (0.02, 0.05, 0.09):
        line = Line(LinkConditions(delay=0.03))
        line.run(1)
        pauses(line, 0.7, length)
        for _ in range(50):
            line.run(0.1)
            assert line.meter.capacity == math.inf
            assert line.meter.queue < 0.002


def test_a_fast_link_has_no_capacity_and_no_queue():
    line = Line(LinkConditions(delay=0.03))
    line.run(3)
    assert line.meter.capacity == math.inf
    assert line.meter.queue == 0
    assert line.meter.rate == pytest.approx((100 * 180 + 15 * 40 * 1200) * 8, rel=0.2)


@pytest.mark.parametrize("loss", [0.05, 0.3])
def test_random_loss_is_no_congestion(loss):
    line = Line(LinkConditions(delay=0.03, loss=loss))
    line.run(5)
    assert line.meter.capacity == math.inf
    assert line.meter.queue == 0


@pytest.mark.parametrize("seed", range(5))
def test_jitter_is_no_congestion(seed):
    line = Line(LinkConditions(delay=0.098, jitter=0.024, loss=0.027, seed=seed))
    worst, queue = math.inf, 0.0
    for _ in range(20):
        line.run(0.5)
        worst, queue = min(worst, line.meter.capacity), max(queue, line.meter.queue)
    assert worst > 30e6
    assert queue < 0.02


def test_behind_jitter_the_capacity_is_found_in_seconds():
    line = Line(LinkConditions(delay=0.098, jitter=0.024, loss=0.027, rate=20e6))
    found = []
    for _ in range(20):
        line.run(0.3, rate=100e6)
        found.append(line.meter.capacity)
    assert 14e6 < min(found) < 35e6


def test_a_standing_queue_is_measured_and_forgotten():
    line = Line(LinkConditions(delay=0.03))
    line.run(2)
    line.model.conditions = LinkConditions(delay=0.08)
    line.run(2)
    assert line.meter.queue == pytest.approx(0.05, abs=0.003)
    line.model.conditions = LinkConditions(delay=0.03)
    line.run(2)
    assert line.meter.queue < 0.002


def test_a_capacity_that_grows_is_noticed():
    line = Line(LinkConditions(delay=0.03, rate=8e6))
    line.run(2)
    assert line.meter.capacity < 10e6
    line.model.conditions = LinkConditions(delay=0.03)
    line.run(6)
    assert line.meter.capacity == math.inf


def test_times_wrap_and_any_times_are_borne():
    assert ticks(TICKS * TICK + 5 * TICK) == 5
    random, meter = Random(1), DelayMeter()
    for i in range(5000):
        meter.add(random.getrandbits(32), random.getrandbits(16), random.randint(33, 65_507), i * 1e-3)
        if random.random() < 0.02:
            meter.evaluate(i * 1e-3)
            assert meter.capacity > 0
            assert meter.queue >= 0
    flood = DelayMeter()
    for i in range(40):
        flood.add_all(array("I", range(4000)).tobytes(), array("H", [7] * 4000).tobytes(), 1200, i * 1e-3)
        assert deep_size(flood) < 20 * COLLECT


@pytest.mark.parametrize(("pause", "queue"), [(0.045, False), (0.3, True)])
def test_what_waits_for_a_busy_receiver_is_no_queue_unless_it_cannot_keep_up(pause, queue):
    path = Path(0, Config(), 0.0)
    for number in range(2000):
        sent = number * 0.001
        late = pause if sent >= 1.0 else 0.0
        path.comes(500, 1, sent + 0.01 + late, late)
        path.arrived(number, ticks(sent), 500)
        if number % 100 == 99:
            path.feedback(sent + 0.01 + late)
    assert (path.feedback(2.5).queue > 0.05) is queue
