"""What is made of the counts of lost packets."""

import math
from random import Random

import pytest

from skytether.wire.fec.loss import LossEstimate, LossModel, Sums


class Path:
    """Losses in runs, told every 100 ms."""

    def __init__(self, assumed=0.05, per_second=700, seed=1):
        self.estimate = LossEstimate(assumed)
        self.random = Random(seed)
        self.per_second = per_second
        self.total = [0, 0, 0, 0.0, 0.0]
        self.now = 0.0

    def run(self, seconds, loss, burst=None, packet_time=0.0014):
        lost, run = False, 0
        for _ in range(round(seconds / 0.1)):
            for _ in range(self.per_second // 10):
                if burst is None:
                    lost = self.random.random() < loss
                else:
                    lost = self.random.random() < (1 - 1 / burst if lost else loss / (1 - loss) / burst)
                self.total[0] += 1
                if lost:
                    self.total[1] += 1
                    self.total[2] += run == 0
                    run += 1
                elif run:
                    duration = (run - 1) * packet_time
                    self.total[3] += duration
                    self.total[4] += duration**2
                    run = 0
            self.now += 0.1
            self.estimate.update(Sums(*self.total), self.now)
        return self.estimate.model


def test_an_unknown_path_is_taken_to_lose_what_is_assumed_until_packets_say_otherwise():
    path = Path()
    assert path.estimate.model == LossModel(0.05)
    assert math.isnan(path.estimate.share)
    assert 0.005 < path.run(0.1, 0).loss < 0.05
    assert path.run(2, 0) == LossModel(0.0)
    assert Path(per_second=20).run(30, 0) == LossModel(0.0)


@pytest.mark.parametrize("loss", [0.01, 0.05, 0.3])
@pytest.mark.parametrize("seed", range(4))
def test_independent_losses_are_found_and_not_taken_for_bursts(loss, seed):
    path = Path(seed=seed)
    model = path.run(20, loss)
    assert 0.75 * loss < model.loss < 1.7 * loss
    assert model[1:] == (1.0, 0.0)
    assert path.estimate.share == pytest.approx(loss, rel=0.3)


@pytest.mark.parametrize("seed", range(4))
def test_bursts_are_counted(seed):
    model = Path(seed=seed).run(20, 0.03, burst=4)
    assert model.burst == pytest.approx(4, rel=0.35)
    # Runs of 1 + n packets, n geometric with mean 3: E(n**2) / E(n) / 2 = 3.5.
    assert model.time == pytest.approx(3.5 * 0.0014, rel=0.4)


def test_up_in_a_second_and_down_slowly():
    path = Path()
    path.run(20, 0.0)
    assert path.run(1, 0.05).loss > 0.025
    before = path.run(20, 0.05).loss
    assert path.run(5, 0).loss > before / 2
    assert path.run(60, 0).loss < 2e-4
    assert path.run(60, 0).loss == 0


def test_sums_wrap_and_old_ones_change_nothing():
    estimate = LossEstimate(0.05)
    estimate.update(Sums(2**32 - 100, 2**32 - 3, 2**32 - 3), 0.0)
    estimate = LossEstimate(0.05)
    estimate.update(Sums(100, 0, 0), 0.0)
    assert estimate.update(Sums(200, 5, 5), 1.0) == Sums(100, 5, 5)
    assert estimate.update(Sums(150, 3, 3), 1.1) == Sums()
    assert estimate.update(Sums(300, 5, 5), 1.2) == Sums(100, 0, 0)
    wrapping = LossEstimate(0.05)
    wrapping.update(Sums(2**31 - 1), 0.0)
    wrapping.update(Sums(2**32 - 10), 0.1)
    assert wrapping.update(Sums(5, 3, 1), 0.2) == Sums(15, 3, 1)


def test_rounding_is_up_and_keeps_what_is_exact():
    assert LossModel(0.0).rounded() == LossModel(0.0)
    rounded = LossModel(0.0123, 3.9, 0.02).rounded()
    assert 0.0123 <= rounded.loss < 0.0123 * 1.11
    assert 3.9 <= rounded.burst < 3.9 * 1.29
    assert 0.02 <= rounded.time < 0.02 * 1.29
    assert rounded.rounded() == rounded
