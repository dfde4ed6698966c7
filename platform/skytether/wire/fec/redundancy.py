"""How many packets more than needed a message gets, and how far apart (rule 5).

As few as reach a topic's ``delivery`` under the losses that the peer reports, whose bursts are counted: neighbours of
a lost packet are more likely to be lost, so parity is planned by the distribution of losses in a run of packets, and
copies keep a distance at which the burst that took the first is likely to be over.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..config import Config
from .fragment import MAX_SHARDS
from .loss import LossModel

APART = 3.0
"""Mean durations of a burst between two copies: 5 % of bursts last longer."""
SPREAD = 0.5
"""Share of a message's lifespan in which its copies are sent."""
FEW = 4
"""Data shards up to which a message's parity is sent in waves where losses come in bursts: a burst that takes one of
its packets may take all that are sent at once."""


class Copies(NamedTuple):
    """How often a one-shard message is sent again, and with how many seconds in between."""

    more: int
    spacing: float


@lru_cache(maxsize=4096)
def plan(k: int, delivery: float, loss: float, limit: int) -> int:
    """Fewest extra packets with which ``k`` of ``k + m`` arrive with probability ``delivery``.

    Args:
        k: Data shards needed.
        delivery: Target, in (0, 1).
        loss: Probability that a packet is lost, independently, in [0, 1).
        limit: Most extra packets; the answer when the target cannot be met.
    """
    # P(exactly j of k + m lost, the last packet arriving) is negative binomial: C(k-1+j, j) (1-p)^k p^j. Its sum over
    # j <= m is P(the k-th arrival comes by packet k+m), so each further packet adds one term.
    term = (1 - loss) ** k
    reached = term
    extra = 0
    while reached < delivery and extra < limit:
        extra += 1
        term *= loss * (k - 1 + extra) / extra
        reached += term
    return extra


@lru_cache(maxsize=4096)
def plan_bursts(k: int, delivery: float, loss: float, burst: float, limit: int) -> int:
    """The same for losses in runs of ``burst`` packets on average, more than 1 (a Gilbert chain)."""
    end = 1 / burst
    begin = min(end * loss / (1 - loss), 1.0)
    # good[j], bad[j]: P(j packets lost so far, and the last one arrived or was lost).
    good, bad = np.zeros(limit + 1), np.zeros(limit + 1)
    good[0] = 1 - loss
    bad[1:2] = loss
    for count in range(2, k + limit + 1):
        stay = good * (1 - begin) + bad * end
        bad[1:] = (good * begin + bad * (1 - end))[:-1]
        bad[0] = 0.0
        good = stay
        if count >= k:
            m = count - k
            if good[: m + 1].sum() + bad[: m + 1].sum() >= delivery:
                return m
    return limit


@lru_cache(maxsize=1024)
def plan_copies(
    delivery: float, model: LossModel, spacing: float, budget: float, limit: int, pace: float = math.inf
) -> Copies:
    """Fewest copies of a single packet that reach ``delivery``.

    Args:
        delivery: Target, in (0, 1).
        model: Losses.
        spacing: Least seconds between two.
        budget: Seconds in which all of them have to be sent.
        limit: Most copies; the answer when the target cannot be met.
        pace: Packets that are sent in a second. Whether a burst is over after some time or after some packets cannot
            be known, so both have to pass.
    """
    if not model.time:
        return Copies(plan(1, delivery, model.loss, limit), spacing)
    if 1 - model.loss >= delivery:
        return Copies(0, spacing)
    each = -math.log(1 - 1 / model.burst) if model.burst > 1 else math.inf
    # How much less likely it becomes with each second that a burst goes on.
    ends = min(each * pace, 1 / model.time)
    apart = spacing
    for count in range(1, limit + 1):
        apart = max(spacing, min(APART / ends, budget / count))
        # A burst that took one packet takes the next if it goes on for that long; else they are lost independently.
        stays = max(math.exp(-apart / model.time), math.exp(-each * max(pace * apart, 1.0)))
        again = model.loss + (1 - model.loss) * stays
        if 1 - model.loss * again**count >= delivery:
            return Copies(count, apart)
    return Copies(limit, apart)


class Redundancy:
    """Plans for one path.

    Attributes:
        model: Losses of the path.
    """

    __slots__ = ("_config", "model", "pace")

    def __init__(self, config: Config) -> None:
        self._config = config
        self.model = LossModel(config.assumed_loss)
        self.pace = math.inf
        """Packets that are sent in a second, but for those of large messages, which go together."""

    def copies(self, delivery: float, lifespan: float) -> Copies:
        """For a message of one shard."""
        config = self._config
        return plan_copies(
            delivery, self.model, config.copy_spacing, SPREAD * lifespan, config.max_copies - 1, self.pace
        )

    def waves(self, k: int, delivery: float, lifespan: float) -> Copies:
        """For a message of ``k`` data shards: how often as many parity shards follow later; none if not in waves."""
        config, model = self._config, self.model
        if not model.time or model.burst <= 1 or k > FEW:
            return Copies(0, 0.0)
        limit = max(int(k * config.max_parity + 0.5), config.max_copies - 1) // k
        # Any of a wave's packets may be the first one of a burst.
        begin = min(model.loss / (1 - model.loss) / model.burst, 1.0)
        wave = model._replace(loss=1 - (1 - model.loss) * (1 - begin) ** (k - 1))
        return plan_copies(delivery, wave, config.copy_spacing, SPREAD * lifespan, limit, self.pace)

    def parity(self, k: int, blocks: int, delivery: float) -> int:
        """Parity shards for each block of ``k`` data shards of a message that has ``blocks``.

        Each of the blocks must arrive, so each has the target's root.
        """
        config, model = self._config, self.model
        limit = min(max(int(k * config.max_parity + 0.5), config.max_copies - 1), MAX_SHARDS - k)
        each = delivery ** (1 / blocks)
        if model.burst > 1 and limit:
            return plan_bursts(k, each, model.loss, model.burst, limit)
        return plan(k, each, model.loss, limit)
