"""Extra packets against the binomial distribution computed directly."""

from math import comb

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.wire import Config
from skytether.wire.redundancy import FixedRedundancy, plan


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


def test_the_policy_keeps_to_the_limits_of_its_configuration():
    policy = FixedRedundancy(Config(assumed_loss=0.4, max_copies=3, max_parity=0.25))
    assert policy(1, 1, 0.99999) == 2
    assert policy(40, 1, 0.99999) == 10
    assert policy(2, 1, 0.99999) == 2  # not fewer than a single packet has
    assert FixedRedundancy(Config(assumed_loss=0.8, max_parity=9))(100, 2, 0.9999) == 156


def test_each_of_many_blocks_gets_more_than_an_only_one():
    policy = FixedRedundancy(Config())
    assert policy(100, 100, 0.99) > policy(100, 1, 0.99)


@pytest.mark.parametrize("blocks", [1, 7, 145])
def test_the_whole_message_meets_its_target(blocks):
    m = FixedRedundancy(Config())(100, blocks, 0.99)
    assert delivered(100, m, 0.05) ** blocks >= 0.99
