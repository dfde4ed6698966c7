"""The plan of a world: walls, things, goals, people. Data only; a building is a YAML file, a field is generated."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml
from numpy.typing import NDArray

from skytether.lab.trail import Pose

T = TypeVar("T")


class PlanError(ValueError):
    """The plan cannot be used; the text says what is wrong and where."""


@dataclass(frozen=True, slots=True)
class Box:
    """Something with corners that stands on the floor.

    Attributes:
        name: Unique in the plan; the judge of contacts tells it.
        x: Of its middle [m].
        y: Of its middle [m].
        length: Along its own x axis [m].
        width: Along its own y axis [m].
        turn: Of that axis against the plan's [rad].
        height: [m].
        mapped: Whether the map of the building shows it.
        wall: Whether it is a part of the building.
    """

    name: str
    x: float
    y: float
    length: float
    width: float
    turn: float = 0.0
    height: float = 1.0
    mapped: bool = True
    wall: bool = False

    def corners(self) -> NDArray[np.float64]:
        """Shape (4, 2), m, counterclockwise."""
        cos, sin = math.cos(self.turn), math.sin(self.turn)
        half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (self.length / 2, self.width / 2)
        return np.asarray(half @ np.array([[cos, sin], [-sin, cos]]) + (self.x, self.y))

    def distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """From points, shape (n, 2), to its surface [m]; 0 inside."""
        dx, dy = points[:, 0] - self.x, points[:, 1] - self.y
        cos, sin = math.cos(self.turn), math.sin(self.turn)
        along = np.maximum(np.abs(cos * dx + sin * dy) - self.length / 2, 0.0)
        across = np.maximum(np.abs(cos * dy - sin * dx) - self.width / 2, 0.0)
        return np.asarray(np.hypot(along, across))


@dataclass(frozen=True, slots=True)
class Cylinder:
    """Something round that stands on the floor; fields as those of `Box`."""

    name: str
    x: float
    y: float
    radius: float
    height: float = 1.0
    mapped: bool = True

    def distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """From points, shape (n, 2), to its surface [m]; 0 inside."""
        away = np.hypot(points[:, 0] - self.x, points[:, 1] - self.y) - self.radius
        return np.asarray(np.maximum(away, 0.0))


@dataclass(frozen=True, slots=True)
class Walk:
    """What a person does.

    Attributes:
        name: Unique in the plan.
        way: Points that are walked to one after the other, shape (n, 2), m. The person begins at the first one.
        speed: [m/s].
        pause: Standing time at each point between the first and the last [s].
        after: ``(x, y, distance)`` [m]: begins when a robot has come so near to that point. None: at once.
        again: Begin anew at the end of the way, for ever.
    """

    name: str
    way: tuple[tuple[float, float], ...]
    speed: float
    pause: float = 0.0
    after: tuple[float, float, float] | None = None
    again: bool = False


@dataclass(frozen=True, slots=True)
class Plan:
    """A world at rest.

    Attributes:
        name: For titles and files.
        boxes: Walls and things.
        cylinders: Round things.
        starts: Where robots stand at the beginning; at least one.
        goals: To be reached in this order, with the heading on arrival.
        people: Who is always there.
        rounds: Who comes on request, in this order.
    """

    name: str
    boxes: tuple[Box, ...]
    cylinders: tuple[Cylinder, ...]
    starts: tuple[Pose, ...]
    goals: tuple[Pose, ...]
    people: tuple[Walk, ...] = ()
    rounds: tuple[Walk, ...] = ()

    def bounds(self) -> tuple[float, float, float, float]:
        """``(x_min, y_min, x_max, y_max)`` of all that stands there and of starts and goals [m]."""
        points = [box.corners() for box in self.boxes]
        points += [
            np.array([(c.x - c.radius, c.y - c.radius), (c.x + c.radius, c.y + c.radius)]) for c in self.cylinders
        ]
        points.append(np.array([(p.x, p.y) for p in (*self.starts, *self.goals)]))
        every = np.concatenate(points)
        (x_min, y_min), (x_max, y_max) = every.min(axis=0), every.max(axis=0)
        return float(x_min), float(y_min), float(x_max), float(y_max)

    def way_length(self) -> float:
        """Of the straight lines from the first start through all goals [m]."""
        points = [self.starts[0], *self.goals]
        return sum(math.dist(a[:2], b[:2]) for a, b in itertools.pairwise(points))

    def clearance(self, points: NDArray[np.float64], *, mapped_only: bool = False) -> NDArray[np.float64]:
        """From points, shape (n, 2), to whatever is nearest [m]; 0 inside of something."""
        nearest = np.full(len(points), np.inf)
        things: list[Box | Cylinder] = [*self.boxes, *self.cylinders]
        for thing in things:
            if thing.mapped or not mapped_only:
                nearest = np.minimum(nearest, thing.distance(points))
        return nearest


@cache
def building() -> Plan:
    """The building of the navigation experiment: nine goals, 41 m (``building.yaml``)."""
    return parse_plan(files(__package__).joinpath("building.yaml").read_text(encoding="utf-8"))


@cache
def hall() -> Plan:
    """The hall of the follow-in-front experiment, with some furniture about the path (``hall.yaml``)."""
    return parse_plan(files(__package__).joinpath("hall.yaml").read_text(encoding="utf-8"))


def read_plan(path: Path) -> Plan:
    """Read a plan of one's own, written like ``building.yaml``.

    Raises:
        PlanError: It is not a plan.
        OSError: It cannot be read.
    """
    try:
        return parse_plan(path.read_text(encoding="utf-8"))
    except (PlanError, UnicodeDecodeError) as error:
        raise PlanError(f"{path}: {error}") from error


def parse_plan(text: str) -> Plan:
    """A plan from YAML.

    Raises:
        PlanError: It is not a plan.
    """
    try:
        document = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise PlanError(f"it is not valid YAML: {error}") from error
    known = {
        "name",
        "wall_height",
        "wall_thickness",
        "walls",
        "boxes",
        "cylinders",
        "starts",
        "goals",
        "people",
        "rounds",
    }
    _check_keys("the plan", document, known, {"starts", "goals"})
    thickness, height = _number("wall_thickness", document, 0.12), _number("wall_height", document, 2.5)
    boxes = [_wall(i, line, thickness, height) for i, line in enumerate(_rows(document, "walls"))]
    plan = Plan(
        name=str(document.get("name", "world")),
        boxes=(*boxes, *(_box(i, row) for i, row in enumerate(_rows(document, "boxes")))),
        cylinders=tuple(_cylinder(i, row) for i, row in enumerate(_rows(document, "cylinders"))),
        starts=tuple(_pose(f"starts[{i}]", row) for i, row in enumerate(_rows(document, "starts"))),
        goals=tuple(_pose(f"goals[{i}]", row) for i, row in enumerate(_rows(document, "goals"))),
        people=tuple(_walk(f"people[{i}]", row, again=False) for i, row in enumerate(_rows(document, "people"))),
        rounds=tuple(_walk(f"rounds[{i}]", row, again=True) for i, row in enumerate(_rows(document, "rounds"))),
    )
    if not plan.starts or not plan.goals:
        raise PlanError("it needs at least one start and one goal")
    named: list[Box | Cylinder | Walk] = [*plan.boxes, *plan.cylinders, *plan.people, *plan.rounds]
    names = [thing.name for thing in named]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise PlanError(f"two things have the name {twice[0]}")
    return plan


def _wall(index: int, line: object, thickness: float, height: float) -> Box:
    x0, y0, x1, y1 = _numbers(f"walls[{index}]", line, 4)
    length = math.hypot(x1 - x0, y1 - y0)
    if length == 0:
        raise PlanError(f"walls[{index}]: it has no length")
    turn = math.atan2(y1 - y0, x1 - x0)
    # By its thickness longer, so that corners are closed.
    return Box(
        f"wall-{index}",
        (x0 + x1) / 2,
        (y0 + y1) / 2,
        length + thickness,
        thickness,
        turn,
        height,
        mapped=True,
        wall=True,
    )


def _box(index: int, row: object) -> Box:
    where = f"boxes[{index}]"
    row = _check_keys(where, row, {"name", "at", "size", "turn", "height", "mapped"}, {"at", "size"})
    x, y = _numbers(f"{where}.at", row["at"], 2)
    length, width = _numbers(f"{where}.size", row["size"], 2)
    if min(length, width) <= 0:
        raise PlanError(f"{where}.size: both must be greater than 0")
    turn, height = math.radians(_number("turn", row, 0.0)), _number("height", row, 1.0)
    return Box(str(row.get("name", f"box-{index}")), x, y, length, width, turn, height, bool(row.get("mapped", True)))


def _cylinder(index: int, row: object) -> Cylinder:
    where = f"cylinders[{index}]"
    row = _check_keys(where, row, {"name", "at", "radius", "height", "mapped"}, {"at", "radius"})
    x, y = _numbers(f"{where}.at", row["at"], 2)
    radius, height = _number("radius", row, 0.0), _number("height", row, 1.0)
    if radius <= 0:
        raise PlanError(f"{where}.radius: it must be greater than 0")
    return Cylinder(str(row.get("name", f"cylinder-{index}")), x, y, radius, height, bool(row.get("mapped", True)))


def _walk(where: str, row: object, *, again: bool) -> Walk:
    row = _check_keys(where, row, {"name", "way", "speed", "pause", "after"}, {"name", "way", "speed"})
    points = [_numbers(f"{where}.way[{i}]", point, 2) for i, point in enumerate(_rows(row, "way"))]
    speed, after = _number("speed", row, 0.0), row.get("after")
    if len(points) < 2 or speed <= 0:
        raise PlanError(f"{where}: it needs a way of two points or more and a speed greater than 0")
    near = None if after is None else _numbers(f"{where}.after", after, 3)
    return Walk(
        str(row["name"]),
        tuple((x, y) for x, y in points),
        speed,
        _number("pause", row, 0.0),
        None if near is None else (near[0], near[1], near[2]),
        again,
    )


def _pose(where: str, row: object) -> Pose:
    x, y, heading = _numbers(where, row, 3)
    return Pose(x, y, math.radians(heading))


def _rows(document: Mapping[str, Any], key: str) -> Sequence[object]:
    rows = document.get(key, [])
    if not isinstance(rows, list):
        raise PlanError(f"{key}: it must be a list")
    return rows


def _check_keys(where: str, row: object, known: set[str], needed: set[str]) -> Mapping[str, Any]:
    if not isinstance(row, dict):
        raise PlanError(f"{where}: it must be a mapping")
    unknown, missing = sorted(set(map(str, row)) - known), sorted(needed - set(row))
    if unknown:
        raise PlanError(f"{where}: {unknown[0]} is not known; there are {', '.join(sorted(known))}")
    if missing:
        raise PlanError(f"{where}: {missing[0]} is missing")
    return row


def _number(key: str, row: Mapping[str, Any], default: float) -> float:
    return _numbers(key, [row.get(key, default)], 1)[0]


def _numbers(where: str, row: object, count: int) -> list[float]:
    good = isinstance(row, list) and len(row) == count
    if not good or not all(isinstance(v, int | float) and math.isfinite(v) for v in row):  # type: ignore[attr-defined]
        raise PlanError(f"{where}: it must be {count} numbers, not {row}")
    return [float(value) for value in row]  # type: ignore[attr-defined]
