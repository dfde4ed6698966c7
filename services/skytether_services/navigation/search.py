"""Shortest ways over a costmap's cells: A*, which without a goal is Dijkstra's search."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .compiled import compiled
from .costmap import INSCRIBED, UNKNOWN

_INSCRIBED, _UNKNOWN = INSCRIBED, UNKNOWN
_SLIGHT = 64
_DIAGONAL = 1.4142135623730951


@compiled
def _push(keys: NDArray[np.float32], cells: NDArray[np.int32], n: int, key: float, cell: int) -> int:
    """Onto a binary heap of n entries; returns n + 1."""
    i = n
    while i > 0:
        parent = (i - 1) >> 1
        if keys[parent] <= key:
            break
        keys[i] = keys[parent]
        cells[i] = cells[parent]
        i = parent
    keys[i] = key
    cells[i] = cell
    return n + 1


@compiled
def _pop(keys: NDArray[np.float32], cells: NDArray[np.int32], n: int) -> int:
    """Remove the least of n entries, which the caller has read at index 0; returns n - 1."""
    n -= 1
    key = keys[n]
    cell = cells[n]
    i = 0
    while True:
        child = 2 * i + 1
        if child >= n:
            break
        if child + 1 < n and keys[child + 1] < keys[child]:
            child += 1
        if keys[child] >= key:
            break
        keys[i] = keys[child]
        cells[i] = cells[child]
        i = child
    keys[i] = key
    cells[i] = cell
    return n


@compiled
def search(
    costs: NDArray[np.uint8], start: int, goal: int, weight: float, unknown: bool
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """The cheapest way from a cell to all others, or until the goal is reached.

    A step costs its length in cells, times 1 + weight * cost / 252 of the cell that it leads into. Steps go to the
    eight neighbours, but not between two blocked cells or past a blocked one's corner.

    Args:
        costs: Inflated, rows by columns; from 253 on a cell is blocked.
        start: Index of the first cell, row by row; it may be blocked itself.
        goal: Likewise; below 0: none, all that can be reached is.
        weight: How much dearer a cell just free of collision is.
        unknown: Cells that nobody has seen may be used, at the price of a cost of 126.

    Returns:
        The way's cost to each cell (infinite: not reached), and the cell before it (-1: none).
    """
    rows, columns = costs.shape
    flat = costs.ravel()
    size = rows * columns
    price = np.empty(256, dtype=np.float32)
    for value in range(256):
        price[value] = 1.0 + weight * value / (_INSCRIBED - 1) if value < _INSCRIBED else np.inf
    if unknown:
        price[_UNKNOWN] = 1.0 + weight * 0.5
    best = np.full(size, np.inf, dtype=np.float32)
    before = np.full(size, -1, dtype=np.int32)
    done = np.zeros(size, dtype=np.bool_)
    # Every cell is pushed once for each neighbour that is done, at most.
    keys = np.empty(8 * size + 1, dtype=np.float32)
    cells = np.empty(8 * size + 1, dtype=np.int32)
    goal_row, goal_column = goal // columns, goal % columns
    best[start] = 0.0
    n = _push(keys, cells, 0, 0.0, start)
    while n > 0:
        cell = cells[0]
        n = _pop(keys, cells, n)
        if done[cell]:
            continue
        done[cell] = True
        if cell == goal:
            break
        row, column = cell // columns, cell % columns
        here = best[cell]
        for dr in range(-1, 2):
            r = row + dr
            if r < 0 or r >= rows:
                continue
            for dc in range(-1, 2):
                c = column + dc
                if (dr == 0 and dc == 0) or c < 0 or c >= columns:
                    continue
                to = r * columns + c
                if done[to]:
                    continue
                length = 1.0
                if dr != 0 and dc != 0:
                    beside, above = price[flat[row * columns + c]], price[flat[r * columns + column]]
                    if beside == np.inf or above == np.inf:
                        continue
                    length = _DIAGONAL
                cost = here + length * price[flat[to]]
                if cost < best[to]:
                    best[to] = cost
                    before[to] = cell
                    ahead = 0.0
                    if goal >= 0:
                        along, across = abs(r - goal_row), abs(c - goal_column)
                        low = min(along, across)
                        ahead = max(along, across) - low + _DIAGONAL * low
                    n = _push(keys, cells, n, cost + ahead, to)
    return best, before


@compiled
def walk_back(before: NDArray[np.int32], goal: int) -> NDArray[np.int32]:
    """The cells of a way, from its start to the goal."""
    n = 1
    cell = goal
    while before[cell] >= 0:
        cell = before[cell]
        n += 1
    way = np.empty(n, dtype=np.int32)
    cell = goal
    for i in range(n - 1, -1, -1):
        way[i] = cell
        cell = before[cell]
    return way


@compiled
def line_price(
    costs: NDArray[np.uint8], x0: float, y0: float, x1: float, y1: float, weight: float, unknown: bool
) -> float:
    """What a straight line would cost in ``search``, sampled at half a cell; infinite if it is blocked. In cells."""
    dx, dy = x1 - x0, y1 - y0
    length = np.sqrt(dx * dx + dy * dy)
    n = max(1, int(np.ceil(length * 2.0)))
    total = 0.0
    for i in range(1, n + 1):
        value = costs[int(y0 + dy * i / n), int(x0 + dx * i / n)]
        if value == _UNKNOWN:
            if not unknown:
                return np.inf
            total += 1.0 + weight * 0.5
        elif value >= _INSCRIBED:
            return np.inf
        else:
            total += 1.0 + weight * value / (_INSCRIBED - 1)
    return float(length * total / n)


@compiled
def shortcut(
    costs: NDArray[np.uint8], points: NDArray[np.float64], weight: float, unknown: bool, reach: int
) -> NDArray[np.int32]:
    """Which points of a way to keep: straight lines replace what they are not dearer than.

    Args:
        costs: As in ``search``.
        points: (column, row) of the way, n by 2, in cells.
        weight: As in ``search``.
        unknown: As in ``search``.
        reach: A line replaces at most so many points.
    """
    n = points.shape[0]
    along = np.zeros(n)
    for i in range(1, n):
        piece = line_price(costs, points[i - 1, 0], points[i - 1, 1], points[i, 0], points[i, 1], weight, unknown)
        along[i] = along[i - 1] + piece
    # The cheapest chain of lines, from point to point: the last one counts, as in a shortest way over a graph.
    best = np.full(n, np.inf)
    before = np.zeros(n, dtype=np.int32)
    best[0] = 0.0
    for i in range(n - 1):
        j = i + 1
        step = 1
        while j < n and j - i <= reach:
            price = line_price(costs, points[i, 0], points[i, 1], points[j, 0], points[j, 1], weight, unknown)
            if j == i + 1 and price == np.inf:
                price = 1e9  # the start may be blocked; the way itself stays
            if best[i] + price < best[j]:
                best[j] = best[i] + price
                before[j] = i
            # Near points closely, far ones with larger steps.
            step = max(1, (j - i) // 4)
            if j < n - 1 and j + step > n - 1:
                j = n - 1
            else:
                j += step
    count = 1
    i = n - 1
    while i > 0:
        i = before[i]
        count += 1
    keep = np.empty(count, dtype=np.int32)
    i = n - 1
    for k in range(count - 1, -1, -1):
        keep[k] = i
        i = before[i]
    return keep


@compiled
def relax(
    costs: NDArray[np.uint8], points: NDArray[np.float64], data: float, smooth: float, rounds: int, unknown: bool
) -> NDArray[np.float64]:
    """Pull each inner point between its neighbours and towards where it was (Nav2's simple smoother).

    A point does not move into a cell that is blocked, or that costs more than the one where it is and not little.

    Args:
        costs: As in ``search``.
        points: (column, row) in cells, n by 2, evenly spaced.
        data: Weight of where it was.
        smooth: Weight of the neighbours.
        rounds: Over all points.
        unknown: As in ``search``.
    """
    moved = points.copy()
    for _ in range(rounds):
        for i in range(1, points.shape[0] - 1):
            x = moved[i, 0] + data * (points[i, 0] - moved[i, 0])
            y = moved[i, 1] + data * (points[i, 1] - moved[i, 1])
            x += smooth * (moved[i + 1, 0] + moved[i - 1, 0] - 2.0 * moved[i, 0])
            y += smooth * (moved[i + 1, 1] + moved[i - 1, 1] - 2.0 * moved[i, 1])
            value = costs[int(y), int(x)]
            old = costs[int(moved[i, 1]), int(moved[i, 0])]
            allowed = unknown if value == _UNKNOWN else value < _INSCRIBED and (value <= old or value <= _SLIGHT)
            if allowed:
                moved[i, 0] = x
                moved[i, 1] = y
    return moved
