"""Which legs are whose: one assignment over all people and all legs at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

Floats = NDArray[np.float64]

STRIDE = 0.85
"""Both feet of a person are this near to each other, m."""
_GATE = 0.45
"""A leg is this near to the middle of its person, m: half a stride."""
_GATE_KNOWN = 0.6
"""The same of one who is known to be a person, and may have been seen by one leg for a while, m."""
_DEVIATIONS = 3.0
"""And within so many standard deviations of where it is expected."""
_LEG = 0.18
"""Standard deviation of a leg's place about the middle of its person, m."""
_NEW = 2.0
"""What it costs to give a leg to one who is not yet known to be a person; costs are squared deviations."""
_SECOND = 1.0
"""What a second leg costs beyond: two people with a leg each are likelier than one with both and one with none."""
_NONE = 12.0
"""What it costs to leave a person without a leg: more than any leg within the gate."""
_FAR = 1e6


def assign(
    people: Floats,
    spreads: Floats,
    known: NDArray[np.bool_],
    legs: Floats,
    both: NDArray[np.bool_],
    impossible: NDArray[np.bool_],
) -> list[list[int]]:
    """Give each person two legs at the most, and each leg to one person at the most, at the least cost in all.

    So a person whose one leg hides the other keeps the one that is seen, and two who pass each other do not take
    each other's. Least cost by `scipy.optimize.linear_sum_assignment` (Crouse 2016).

    Args:
        people: Where they are expected, n by (x, y) [m].
        spreads: Standard deviation of each expected place [m].
        known: Who is known to be a person.
        legs: Middles of the clusters, m by (x, y) [m].
        both: Which of them are two legs in one: such a one is a person's only one.
        impossible: n by m: this leg cannot be this person's.

    Returns:
        For each person, indices of the legs.
    """
    count = len(people)
    found: list[list[int]] = [[] for _ in range(count)]
    if count == 0 or len(legs) == 0:
        return found
    apart = np.hypot(people[:, None, 0] - legs[None, :, 0], people[:, None, 1] - legs[None, :, 1])
    spread = np.sqrt(spreads**2 + _LEG**2)[:, None]
    near = apart <= np.minimum(_DEVIATIONS * spread, np.where(known, _GATE_KNOWN, _GATE)[:, None])
    near &= ~impossible
    first = np.where(near, (apart / spread) ** 2 + np.where(known, 0.0, _NEW)[:, None], _FAR)
    second = np.where(near, first + _SECOND, _FAR)
    none = np.full((2 * count, 2 * count), _NONE)
    costs = np.hstack([np.vstack([first, second]), none])
    for row, column in zip(*linear_sum_assignment(costs), strict=True):
        if column < len(legs) and costs[row, column] < _FAR:
            found[row % count].append(int(column))
    return [_plausible(mine, apart[person], legs, both) for person, mine in enumerate(found)]


def _plausible(mine: list[int], apart: Floats, legs: Floats, both: NDArray[np.bool_]) -> list[int]:
    """Of two legs that cannot be one person's, the nearer one."""
    if len(mine) == 2 and (both[mine].any() or np.hypot(*(legs[mine[0]] - legs[mine[1]])) > STRIDE):
        return [min(mine, key=lambda leg: float(apart[leg]))]
    return sorted(mine)


def pairs(legs: Floats, free: Sequence[int], furthest: float) -> list[tuple[int, ...]]:
    """Pair the free legs, the nearest two first; those without another are alone.

    Args:
        legs: n by (x, y) [m].
        free: Indices of those that are nobody's.
        furthest: Between the two of a pair [m].
    """
    near = sorted(
        (float(np.hypot(*(legs[a] - legs[b]))), a, b) for place, a in enumerate(free) for b in free[place + 1 :]
    )
    found: list[tuple[int, ...]] = []
    taken: set[int] = set()
    for apart, a, b in near:
        if apart > furthest:
            break
        if not {a, b} & taken:
            taken |= {a, b}
            found.append((a, b))
    return found + [(leg,) for leg in free if leg not in taken]
