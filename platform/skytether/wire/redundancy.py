"""How many packets more than needed a message gets (rule 5).

For now sized for a fixed share of independent losses; a policy that follows the peer's reports replaces
`FixedRedundancy` without the sender noticing.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Protocol

from .config import Config
from .fragment import MAX_SHARDS


class RedundancyPolicy(Protocol):
    """Asked once per message, or once per block shape of a large one."""

    def __call__(self, k: int, blocks: int, delivery: float) -> int:
        """Extra packets for each block of ``k`` data shards, of which a message has ``blocks``.

        For a one-shard message the extra packets are copies.
        """
        ...


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


class FixedRedundancy:
    """Sized for ``Config.assumed_loss`` whatever the path does."""

    __slots__ = ("_config",)

    def __init__(self, config: Config) -> None:
        self._config = config

    def __call__(self, k: int, blocks: int, delivery: float) -> int:
        """See `RedundancyPolicy`: each of the blocks must arrive, so each has the target's root."""
        config = self._config
        if k == 1 and blocks == 1:
            return plan(1, delivery, config.assumed_loss, config.max_copies - 1)
        limit = min(max(int(k * config.max_parity + 0.5), config.max_copies - 1), MAX_SHARDS - k)
        return plan(k, delivery ** (1 / blocks), config.assumed_loss, limit)
