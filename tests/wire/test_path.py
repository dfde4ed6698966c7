"""Losses and bursts from packet numbers."""

import math
from array import array
from random import Random

import pytest

from skytether.wire.config import Config
from skytether.wire.path import NUMBERS, LossMeter, Path


def feed(meter, numbers, every=200):
    for i, number in enumerate(numbers):
        meter.add(number % NUMBERS)
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
    assert meter.loss == pytest.approx(lost / total, abs=0.02)
    assert meter.burst == pytest.approx(lost / runs, rel=0.1)


def test_reordering_alone_is_not_loss():
    numbers = list(range(3000))
    random = Random(4)
    numbers.sort(key=lambda n: n + random.random() * 100)
    meter = LossMeter()
    feed(meter, numbers)
    assert meter.loss == 0
    assert math.isnan(meter.burst)


def test_false_numbers_far_away_change_nothing():
    meter = LossMeter()
    numbers = []
    for n in range(2000):
        numbers += [n] if n % 10 else [n, n + 10_000_000]
    feed(meter, numbers)
    assert meter.loss == 0


def test_after_a_long_silence_it_begins_again():
    meter = LossMeter()
    feed(meter, [*range(1000), *range(50_000_000, 50_001_000)])
    assert meter.loss == 0
    assert math.isnan(LossMeter().loss)


def test_a_flood_is_bounded_and_batches_count_like_packets():
    meter, other = LossMeter(), LossMeter()
    numbers = [n for n in range(200_000) if n % 7]
    for start in range(0, len(numbers), 50):
        meter.add_all(array("I", numbers[start : start + 50]).tobytes())
        for n in numbers[start : start + 50]:
            other.add(n)
        assert len(meter._numbers) < meter.COLLECT
    meter.evaluate()
    other.evaluate()
    assert meter.loss == pytest.approx(1 / 7, abs=1e-3)
    assert other.loss == pytest.approx(meter.loss, abs=1e-4)


def test_packet_numbers_wrap():
    path = Path(0, Config(), 0.0)
    path.next_number = NUMBERS - 2
    assert path.number(3) == NUMBERS - 2
    assert path.number() == 1
    assert path.packets_sent == 4
