"""Fields of cylinders between a start and a goal, in the manner of the BARN challenge (Perille et al., 2020).

A generator of its own, so a result on these fields is not a BARN score. Like there: many worlds from sparse to dense,
small round obstacles in clumps (a cellular automaton), one start, one goal, a way that is known to exist. The length
of the shortest way is given, for a score that compares with it.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from skytether.lab.trail import Pose

from .plan import Box, Cylinder, Plan
from .robot import RobotParams

WORLDS = 50
"""In one set, from sparse to dense."""

_WIDTH, _LENGTH = 4.8, 9.0
"""Of the field with obstacles, m."""
_APRON = 1.5
"""Free before and behind it, m: start and goal are in its middle."""
_CELL = 0.3
"""Of the automaton, m."""
_FILL = (0.06, 0.17)
"""Share of cells that are filled in the sparsest and in the densest world, before they are smoothed."""
_ROUNDS = 1
"""Of smoothing."""
_RADIUS = (0.075, 0.14)
"""Of a cylinder, m."""
_GRID = 0.1
"""Of the search for a way, m."""
TRIES = 200
"""Fields that are drawn for one world before the search is given up."""
_STEPS = [(x, y, math.hypot(x, y)) for x in range(-2, 3) for y in range(-2, 3) if math.gcd(x, y) == 1]
"""16 directions: the length found on the grid is at most 2.8 % above the true one, before it is straightened."""
_THICKNESS = 0.1

Way = tuple[tuple[float, float], ...]


class NoFieldError(Exception):
    """No field with a way through it was found; the text says what to change."""


@dataclass(frozen=True, slots=True)
class Field:
    """One world.

    Attributes:
        number: In its set, 0 is the sparsest.
        seed: Of the set.
        plan: One start, one goal.
        way: The shortest that was found for the middle of a robot of `clearance`; it is free.
        length: Of that way [m].
        clearance: No obstacle is nearer to the way [m].
    """

    number: int
    seed: int
    plan: Plan
    way: Way
    length: float
    clearance: float


def field(
    number: int, *, seed: int = 1, clearance: float | None = None, worlds: int = WORLDS, tries: int = TRIES
) -> Field:
    """Make one world; the same numbers give the same world.

    Args:
        number: From 0, sparse, to ``worlds - 1``, dense.
        seed: Of the set.
        clearance: Radius that must fit through [m]; None: that of the robot's circumscribed circle.
        worlds: In the set.
        tries: Fields that are drawn before the search is given up; one in three serves.

    Raises:
        ValueError: There is no such number.
        NoFieldError: No way exists for so large a robot.
    """
    if not 0 <= number < worlds:
        raise ValueError(f"the world must be one of 0 to {worlds - 1}, not {number}")
    radius = RobotParams().circumscribed if clearance is None else clearance
    random = np.random.default_rng([seed, number])
    fill = float(np.interp(number, (0, max(worlds - 1, 1)), _FILL))
    for _ in range(tries):
        plan = _plan(f"field-{seed}-{number}", _cylinders(fill, random))
        # A field that can be driven straight through shows nothing.
        if _are_free(plan, np.array([plan.starts[0][:2]]), np.array(plan.goals[0][:2]), radius)[0]:
            continue
        way = shortest_way(plan, radius)
        if way is not None:
            return Field(number, seed, plan, way, way_length(way), radius)
    raise NoFieldError(
        f"no field with a way for a robot of {radius:.2f} m radius was found in {tries} tries; take a smaller"
    )


def shortest_way(plan: Plan, clearance: float) -> Way | None:
    """From the plan's start to its first goal, a little longer than the shortest at most; None: there is none.

    Args:
        plan: With all that stands there, mapped or not.
        clearance: No obstacle may be nearer to it [m].
    """
    x_min, y_min, x_max, y_max = plan.bounds()
    columns, rows = int((x_max - x_min) / _GRID) + 1, int((y_max - y_min) / _GRID) + 1
    xs, ys = x_min + np.arange(columns) * _GRID, y_min + np.arange(rows) * _GRID
    nodes = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1)
    free = (plan.clearance(nodes.reshape(-1, 2)) > clearance).reshape(columns, rows)
    start, goal = plan.starts[0][:2], plan.goals[0][:2]

    def cell(point: tuple[float, float]) -> tuple[int, int]:
        return round((point[0] - x_min) / _GRID), round((point[1] - y_min) / _GRID)

    cells = _search(free, cell(start), cell(goal))
    if cells is None:
        return None
    points = [start, *((float(xs[i]), float(ys[j])) for i, j in cells[1:-1]), goal]
    return _straighten(plan, points, clearance)


def way_length(way: Way) -> float:
    """[m]."""
    return sum(math.dist(a, b) for a, b in pairwise(way))


def _cylinders(fill: float, random: np.random.Generator) -> tuple[Cylinder, ...]:
    """Clumps: cells are filled by chance, then those live on that have neighbours."""
    shape = round(_LENGTH / _CELL), round(_WIDTH / _CELL)
    cells = random.random(shape) < fill
    for _ in range(_ROUNDS):
        padded = np.pad(cells, 1).astype(int)
        around = sum(np.roll(padded, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1))
        neighbours = np.asarray(around)[1:-1, 1:-1] - cells
        cells = (cells & (neighbours >= 1)) | (~cells & (neighbours >= 4))
    found = []
    for index, (i, j) in enumerate(np.argwhere(cells)):
        shift = random.uniform(-0.3, 0.3, 2) * _CELL
        x = float((i + 0.5) * _CELL + shift[0])
        y = float((j + 0.5) * _CELL + shift[1] - _WIDTH / 2)
        found.append(Cylinder(f"pole-{index}", x, y, float(random.uniform(*_RADIUS)), mapped=False))
    return tuple(found)


def _plan(name: str, cylinders: tuple[Cylinder, ...]) -> Plan:
    """Walls around the field; what stands within is in no map."""
    low, high, half = -_APRON, _LENGTH + _APRON, _WIDTH / 2
    middle, length, t = (low + high) / 2, high - low, _THICKNESS
    walls = (
        Box("right", middle, -half - t / 2, length + 2 * t, t, wall=True),
        Box("left", middle, half + t / 2, length + 2 * t, t, wall=True),
        Box("back", low - t / 2, 0.0, t, _WIDTH, wall=True),
        Box("front", high + t / 2, 0.0, t, _WIDTH, wall=True),
    )
    start, goal = Pose(low + _APRON / 2, 0.0, 0.0), Pose(high - _APRON / 2, 0.0, 0.0)
    return Plan(name, walls, cylinders, (start,), (goal,))


def _search(free: NDArray[np.bool_], start: tuple[int, int], goal: tuple[int, int]) -> list[tuple[int, int]] | None:
    """A* over the grid."""
    if not (free[start] and free[goal]):
        return None
    columns, rows = free.shape
    grid = free.tolist()
    best = {start: 0.0}
    before: dict[tuple[int, int], tuple[int, int]] = {}
    waiting = [(math.dist(start, goal), start)]
    closed: set[tuple[int, int]] = set()
    while waiting:
        _, here = heapq.heappop(waiting)
        if here == goal:
            way = [here]
            while way[-1] != start:
                way.append(before[way[-1]])
            return way[::-1]
        if here in closed:
            continue
        closed.add(here)
        i, j = here
        for di, dj, length in _STEPS:
            x, y = i + di, j + dj
            if not (0 <= x < columns and 0 <= y < rows and grid[x][y]):
                continue
            there, cost = (x, y), best[here] + length
            if cost < best.get(there, math.inf):
                best[there] = cost
                before[there] = here
                heapq.heappush(waiting, (cost + math.dist(there, goal), there))
    return None


def _straighten(plan: Plan, points: list[tuple[float, float]], clearance: float) -> Way | None:
    """The shortest way along some of these points whose straight pieces are free; None: a piece between two is not."""
    # Shortest over all pairs, not greedy: a greedy one keeps corners of the grid's way.
    best, before = np.full(len(points), np.inf), [0] * len(points)
    best[0] = 0.0
    corners = np.array(points)
    for last in range(1, len(points)):
        lengths = (
            best[:last] + np.hypot(*(corners[:last] - corners[last]).T) + 1e-9
        )  # fewer pieces where it is all the same
        lengths[~_are_free(plan, corners[:last], corners[last], clearance - 1e-3)] = np.inf
        before[last] = int(np.argmin(lengths))
        best[last] = lengths[before[last]]
    if not math.isfinite(best[-1]):
        return None
    chosen = [len(points) - 1]
    while chosen[-1]:
        chosen.append(before[chosen[-1]])
    return tuple(points[index] for index in reversed(chosen))


def _are_free(plan: Plan, starts: NDArray[np.float64], end: NDArray[np.float64], clearance: float) -> NDArray[np.bool_]:
    """Whether all of each straight line keeps that distance from the cylinders; walls are straight and need no look.

    Args:
        plan: With the cylinders.
        starts: Of the lines, shape (n, 2), m.
        end: Of all lines, shape (2,), m; not one of the starts.
        clearance: [m].
    """
    poles = np.array([(c.x, c.y, c.radius) for c in plan.cylinders]).reshape(-1, 3)
    along = end - starts
    to_pole = poles[None, :, :2] - starts[:, None]
    t = np.clip(np.einsum("npi,ni->np", to_pole, along) / np.einsum("ni,ni->n", along, along)[:, None], 0.0, 1.0)
    away = np.linalg.norm(to_pole - t[..., None] * along[:, None], axis=2) - poles[:, 2]
    return np.asarray((away >= clearance).all(axis=1))
