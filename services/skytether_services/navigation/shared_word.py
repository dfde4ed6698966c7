"""What robots of a group tell each other, as text: where one is, and what it sees that the map lacks.

Text of another robot is believed to be anything: whatever it is, it raises nothing, and what it can hold is bounded.
Cells are those of the map, so a word is of use only to who has the same one: `map_id` tells.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skytether_services.planar.geometry import Pose

from .costmap import Costmap

MOST_TEXT = 8192
"""Characters of a word: what an orchestrator carries."""
MOST_CELLS = 400
"""Of a word: so many fit on any map, with some room."""
MOST_CORNERS = 16
MOST_REACH = 2.0
"""How far from its centre of rotation a robot's outline reaches at most [m]."""
MOST_ROBOTS = 15
"""Whose words are heard."""
_LONGEST_AGE = 3600.0
_FORMAT = 1


class Unheard(StrEnum):
    """Why a word is of no use."""

    BROKEN = "unreadable"
    OTHER_MAP = "another map"


@dataclass(frozen=True)
class Word:
    """What one robot told.

    Attributes:
        pose: Of it on the map.
        outline: Corners of its outline in its own frame, n by 2 [m].
        cells: What it sees that the map lacks: row and column of the map's cells, m by 2, all on the map.
        ages: How long before the word it saw each, m [s].
    """

    pose: Pose
    outline: NDArray[np.float64]
    cells: NDArray[np.intp]
    ages: NDArray[np.float64]


@dataclass(frozen=True)
class Said:
    """A word as it came.

    Attributes:
        robot: Whose it is, as the orchestrator says.
        age: How long ago it was said [s].
        text: The word.
    """

    robot: str
    age: float
    text: str


def map_id(static: Costmap) -> str:
    """The same for maps that show the same, whether they came by file or by topic."""
    rows, columns = static.costs.shape
    frame = f"{rows} {columns} {static.resolution:.5f} {static.origin[0]:.3f} {static.origin[1]:.3f} "
    return hashlib.sha256(frame.encode() + static.costs.tobytes()).hexdigest()[:32]


def write_word(map_: str, word: Word) -> str:
    """As text. Cells beyond `MOST_CELLS` are left out: the oldest."""
    newest = np.argsort(word.ages, kind="stable")[:MOST_CELLS]
    tenths = np.rint(word.ages[newest] * 10).astype(int)
    document = {
        "format": _FORMAT,
        "map": map_,
        "pose": [round(value, 3) for value in word.pose],
        "outline": [[round(float(x), 3), round(float(y), 3)] for x, y in word.outline[:MOST_CORNERS]],
        "cells": np.column_stack((word.cells[newest], tenths)).tolist(),
    }
    return json.dumps(document, separators=(",", ":"))


def read_word(text: str, map_: str, shape: tuple[int, ...]) -> Word | Unheard:
    """What somebody told; cells that are not on the map are left out.

    Args:
        text: From anybody.
        map_: `map_id` of this robot's map.
        shape: Rows and columns of it.
    """
    document = _json(text, MOST_TEXT)
    if not isinstance(document, dict) or document.get("format") != _FORMAT:
        return Unheard.BROKEN
    if document.get("map") != map_:
        return Unheard.OTHER_MAP
    pose, outline = _numbers(document.get("pose"), 1), _numbers(document.get("outline"), 2)
    cells = _numbers(document.get("cells"), 2)
    if pose is None or pose.shape != (3,) or outline is None or outline.ndim != 2 or cells is None:
        return Unheard.BROKEN
    if not 3 <= len(outline) <= MOST_CORNERS or outline.shape[1] != 2 or np.hypot(*outline.T).max() > MOST_REACH:
        return Unheard.BROKEN
    if len(cells) > MOST_CELLS or (cells.size and (cells.ndim != 2 or cells.shape[1] != 3)):
        return Unheard.BROKEN
    cells = cells.reshape(-1, 3)
    on_map = (cells[:, :2] >= 0).all(axis=1) & (cells[:, 0] < shape[0]) & (cells[:, 1] < shape[1])
    cells = cells[on_map & (cells[:, 2] >= 0)]
    ages = np.minimum(cells[:, 2] / 10, _LONGEST_AGE)
    return Word(Pose(*map(float, pose)), outline, cells[:, :2].astype(np.intp), ages)


def read_said(text: str) -> list[Said]:
    """What the robot's agent brings: a list of what the others said; anything else is an empty one."""
    document = _json(text, 3 * MOST_ROBOTS * MOST_TEXT)
    found: list[Said] = []
    for one in document[:MOST_ROBOTS] if isinstance(document, list) else ():
        if not isinstance(one, dict):
            continue
        robot, age, said = one.get("robot"), one.get("age_s"), one.get("text")
        if not (isinstance(robot, str) and len(robot) <= 63 and isinstance(said, str)):
            continue
        if isinstance(age, int | float) and not isinstance(age, bool) and 0 <= age <= _LONGEST_AGE:
            found.append(Said(robot, float(age), said))
    return found


def _json(text: str, longest: int) -> Any:
    try:
        return json.loads(text) if len(text) <= longest else None
    except (ValueError, RecursionError):
        return None


def _numbers(value: object, depth: int) -> NDArray[np.float64] | None:
    """A list of finite numbers, or of lists of as many; None: it is none."""
    if not isinstance(value, list) or len(value) > MOST_CELLS:
        return None
    rows = value if depth == 2 else [value]
    for row in rows:
        if not isinstance(row, list) or len(row) > 3 or len(row) != len(rows[0]):
            return None
        if not all(type(number) in (int, float) and abs(number) < 1e6 and math.isfinite(number) for number in row):
            return None
    return np.array(value, dtype=np.float64)
