"""Extra packets against distributions computed directly, and against simulated bursts."""

from math import comb
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.wire import Config
from skytether.wire.fec.loss import LossModel
from skytether.wire.fec.redundancy import Redundancy, plan, plan_bursts, plan_copies


def delivered(k, m, loss):
    """P(at most m of k + m are lost)."""
    n = k + m
    return sum(comb(n, i) * loss**i * (1 - loss) ** (n - i) for i in range(m + 1))


@given(st.integers(1, 100), st.sampled_from([0.5, 0.9, 0.99, 0.999, 0.99999]), st.floats(0, 0.4))
def test_it_is_the_fewest_that_meet_the_target(k, delivery, loss):
    m = plan(k, delivery, loss, 200)
    assert delivered(k, m, loss) >= delivery - 1e-9
    if m:
        assert delivered(k, m - 1, loss) < delivery + 1e-9


def test_known_values():
    # One packet at 5 %: 0.95, 0.9975, 0.999875 with 0, 1, 2 copies.
    assert [plan(1, d, 0.05, 9) for d in (0.9, 0.99, 0.999)] == [0, 1, 2]
    assert plan(40, 0.999, 0.0, 50) == 0
    assert plan(40, 0.999, 0.5, 7) == 7


class Chain:
    """Losses in runs."""

    def __init__(self, loss, burst, seed=1):
        self.random = Random(seed)
        self.begin, self.end = loss / (1 - loss) / burst, 1 / burst
        self.lost = self.random.random() < loss

    def step(self):
        self.lost = self.random.random() < (1 - self.end if self.lost else self.begin)
        return self.lost


@pytest.mark.parametrize(
    ("k", "delivery", "loss", "burst"), [(40, 0.99, 0.03, 4), (10, 0.98, 0.1, 3), (3, 0.95, 0.2, 2)]
)
def test_parity_for_bursts_meets_its_target_and_no_more(k, delivery, loss, burst):
    m = plan_bursts(k, delivery, loss, burst, 200)
    assert m > plan(k, delivery, loss, 200)
    chain, count, arrived, with_less = Chain(loss, burst), 8000, 0, 0
    for _ in range(count):
        for _ in range(50):  # until it has forgotten the message before
            chain.step()
        lost = [chain.step() for _ in range(k + m)]
        arrived += sum(lost) <= m
        with_less += sum(lost[:-1]) <= m - 1
    tolerance = 3 * (delivery * (1 - delivery) / count) ** 0.5
    assert arrived / count >= delivery - tolerance
    assert with_less / count < delivery + tolerance


def test_bursts_of_one_are_independent_losses():
    # A chain whose runs have the mean 1 / (1 - p) has no memory.
    for loss in (0.01, 0.1, 0.3):
        assert plan_bursts(40, 0.99, loss, 1 / (1 - loss), 100) == plan(40, 0.99, loss, 100)
    assert plan_bursts(40, 0.999, 0.5, 9, 7) == 7


def test_copies_keep_a_distance_at_which_a_burst_is_over():
    model = LossModel(0.03, 4, 0.01)
    near = plan_copies(0.999, LossModel(0.03), 0.002, 0.1, 9)
    assert near == (1, 0.002)
    apart = plan_copies(0.999, model, 0.002, 0.1, 9)
    assert apart.spacing == pytest.approx(0.03)
    tight = plan_copies(0.999, model, 0.002, 0.02, 9)
    assert tight.more > apart.more
    assert tight.spacing * tight.more <= 0.02 + 1e-9
    assert plan_copies(0.96, model, 0.002, 0.1, 9).more == 0
    assert plan_copies(0.999999, LossModel(0.5, 10, 1.0), 0.002, 0.05, 5).more == 5


def test_where_few_packets_are_sent_a_burst_takes_as_many_copies():
    model = LossModel(0.03, 4, 0.01)
    dense = plan_copies(0.999, model, 0.002, 0.1, 20, 1000.0)
    sparse = plan_copies(0.999, model, 0.002, 0.1, 20, 20.0)
    # Each copy is the next packet of the burst: 0.03 * 0.75^n.
    assert sparse.more >= 11
    assert dense.more < 5
    # With 1,000 packets a second, some are in between even if the burst is over in no time.
    assert plan_copies(0.999, LossModel(0.03, 4, 1e-6), 0.002, 0.1, 9, 1000.0).spacing > 0.009


def test_small_messages_follow_in_waves_where_losses_come_in_bursts():
    redundancy = Redundancy(Config())
    assert redundancy.waves(2, 0.999, 0.2).more == 0
    redundancy.model = LossModel(0.03, 4, 0.01)
    redundancy.pace = 500.0
    waves = redundancy.waves(2, 0.999, 0.2)
    assert 1 <= waves.more <= 5
    assert waves.spacing >= 0.015
    assert waves.spacing * waves.more <= 0.1
    assert redundancy.waves(40, 0.999, 0.2).more == 0


def test_spread_copies_meet_their_target_in_bursts_of_time():
    model, delivery, count, random = LossModel(0.05, 4, 0.01), 0.995, 20_000, Random(2)
    more, spacing = plan_copies(delivery, model, 0.002, 0.2, 9)
    arrived = 0
    for _ in range(count):
        # On and off for exponential times; seen by packets at 0, spacing, 2 spacing ...
        bad, left, got = random.random() < model.loss, 0.0, False
        left = random.expovariate(1 / model.time if bad else model.loss / (1 - model.loss) / model.time)
        for _ in range(more + 1):
            got = got or not bad
            gap = spacing
            while gap > left:
                gap -= left
                bad = not bad
                left = random.expovariate(1 / model.time if bad else model.loss / (1 - model.loss) / model.time)
            left -= gap
        arrived += got
    assert arrived / count >= delivery - 3 * (delivery * (1 - delivery) / count) ** 0.5


def policy(loss=0.05, **config):
    redundancy = Redundancy(Config(**config))
    redundancy.model = LossModel(loss)
    return redundancy


def test_the_policy_keeps_to_the_limits_of_its_configuration():
    redundancy = policy(0.4, max_copies=3, max_parity=0.25)
    assert redundancy.copies(0.99999, 1.0).more == 2
    assert redundancy.parity(40, 1, 0.99999) == 10
    assert redundancy.parity(2, 1, 0.99999) == 2  # not fewer than a single packet has
    assert policy(0.8, max_parity=9).parity(100, 2, 0.9999) == 156
    assert policy(max_parity=0, max_copies=1).parity(100, 1, 0.9999) == 0


def test_nothing_lost_costs_nothing_and_the_unknown_costs_what_is_assumed():
    assert policy(0.0).copies(0.99999, 0.1).more == 0
    assert policy(0.0).parity(40, 1, 0.99999) == 0
    assert Redundancy(Config(assumed_loss=0.1)).parity(40, 1, 0.99) == policy(0.1).parity(40, 1, 0.99)


def test_each_of_many_blocks_gets_more_than_an_only_one():
    assert policy().parity(100, 100, 0.99) > policy().parity(100, 1, 0.99)


@pytest.mark.parametrize("blocks", [1, 7, 145])
def test_the_whole_message_meets_its_target(blocks):
    m = policy().parity(100, blocks, 0.99)
    assert delivered(100, m, 0.05) ** blocks >= 0.99
