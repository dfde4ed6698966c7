"""Other robots of the group on the same map: what they see and where they are, and what this one tells them.

What others say is a layer of its own above this robot's costmap: it adds to what the planner goes round, and takes
nothing away. It is bounded in size, range and age; what this robot's own laser finds free since is free; and nothing of
it counts where the robot itself stands. So who lies can have it make a detour, for as long as he goes on.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from skytether.service import param
from skytether_services.planar.geometry import Pose

from .costmap import FREE, LETHAL, UNKNOWN, Costmap, Costs
from .footprint import Footprint
from .obstacles import ObstacleParams, Scan, mark_and_clear
from .shared_word import MOST_CORNERS, MOST_ROBOTS, Said, Unheard, Word, map_id, read_word, write_word

_LISTENING = 10.0
"""Without news of the group for so long [s], which come each second, nothing is told."""
_LEAST = 0.4
"""News that come sooner after the last [s] are not read: nobody takes this robot's time."""
_BESIDE = 0.2
"""What is as near to a wall of the map [m] is taken for the wall: poses and maps are not as exact as the laser."""
_APART = 0.3
"""What is as near to a robot's outline [m] is taken for the robot, likewise; and its way since it told its pose: """
_SPEED = 0.5
"""as fast as this [m/s]."""
_SURELY = 1.0
"""When a neighbour saw something is known as well as this [s]."""
_TRAIL = 1000
"""Own poses that are kept: 100 s at the usual rate of scans."""


@dataclass(frozen=True)
class SharingParams:
    """What robots of one group (`skytether robot group`) tell each other; without a group nothing is told or heard."""

    tell: bool = param(True, doc="tell the others where this robot is, and what it sees that the map lacks")
    listen: bool = param(True, doc="plan round the others, and round what they see")
    obstacles_last: float = param(
        60.0, unit="s", gt=0, le=600, doc="what a robot saw counts for so long after it saw it last"
    )
    robots_last: float = param(
        5.0, unit="s", gt=0, le=60, doc="a robot counts as being where it was for so long after it said so"
    )
    reach: float = param(30.0, unit="m", gt=0, doc="what is farther from this robot does not count")


@dataclass(frozen=True)
class _Heard:
    """A word, by this robot's clock.

    Attributes:
        at: When it was said [s].
        word: What.
        seen: When each cell was seen [s].
        body: Cells below the robot that said it, n by 2.
    """

    at: float
    word: Word
    seen: NDArray[np.float64]
    body: NDArray[np.intp]


class Neighbours:
    """Of one robot on one map. Time is an argument, in seconds of one clock."""

    def __init__(self, params: SharingParams, static: Costmap, footprint: Footprint, obstacles: ObstacleParams) -> None:
        """Begin without any.

        Args:
            params: What is told and heard.
            static: The map; its own cells are those of all layers here.
            footprint: Of this robot.
            obstacles: Ranges of its laser.
        """
        self._params = params
        self._static = static
        self._id = map_id(static)
        self._outline = outline(footprint)
        self._reach = footprint.circumscribed
        self._mark_range = obstacles.mark_range
        self._clears = replace(obstacles, mark_range=1e-9)
        self._heard_at = -math.inf
        self._heard: dict[str, _Heard] = {}
        self._unheard: dict[str, tuple[float, Unheard]] = {}
        self._waiting: deque[tuple[float, Said]] = deque()
        """Words that were not read yet, and when they were said."""
        self._trail: deque[tuple[float, float, float]] = deque(maxlen=_TRAIL)
        self._away: NDArray[np.bool_] | None = None
        """Cells that the map knows as free, away from its walls; None: not needed yet. So are these:"""
        self._began = 0.0
        self._marked = self._cleared = np.empty(0, dtype=np.float32)
        """When this robot's own laser last saw something in a cell, and nothing in one of another's [s since then]."""
        self._scratch = np.empty(0, dtype=np.uint8)

    def is_listening(self, now: float) -> bool:
        """Whether there is a group: news of it came a moment ago."""
        return now - self._heard_at <= _LISTENING

    def names(self, now: float) -> dict[str, str]:
        """By robot that told something a moment ago: ``heard``, or why it is of no use."""
        if not self.is_listening(now):
            return {}
        heard = {robot: "heard" for robot, one in self._heard.items() if now - one.at <= _LISTENING}
        return {**heard, **{robot: str(why) for robot, (at, why) in self._unheard.items() if now - at <= _LISTENING}}

    def receive(self, now: float, said: Sequence[Said]) -> None:
        """Take what the others said, for `read`; while something waits to be read, nothing more is taken."""
        if now - self._heard_at < _LEAST:
            return
        if self._away is None:
            self._prepare(now)
        self._heard_at = now
        self._unheard = {robot: one for robot, one in self._unheard.items() if now - one[0] <= _LISTENING}
        if not self._waiting:
            self._waiting.extend((now - one.age, one) for one in said[:MOST_ROBOTS])

    def read(self, now: float) -> bool:
        """Read one word that waits, which takes the place of its robot's last one: a crowd is not to hold up the loop.

        Returns:
            Whether more wait.
        """
        if not self._waiting:
            return False
        at, one = self._waiting.popleft()
        self._unheard.pop(one.robot, None)
        word = read_word(one.text, self._id, self._static.costs.shape)
        if isinstance(word, Unheard):
            self._unheard[one.robot] = (at, word)
            self._unheard = dict(list(self._unheard.items())[-MOST_ROBOTS:])
        else:
            self._heard[one.robot] = self._without_me(_Heard(at, word, at - word.ages, self._below(word)))
            newest = sorted(self._heard, key=lambda robot: -self._heard[robot].at)[:MOST_ROBOTS]
            lasts = self._params.obstacles_last
            self._heard = {robot: self._heard[robot] for robot in newest if now - self._heard[robot].at <= lasts}
        return bool(self._waiting)

    def observe(self, now: float, pose: Pose, scan: Scan) -> None:
        """Note what this robot's own laser sees: what it can tell, and what of the others' word is not so."""
        if self._away is None or not self.is_listening(now):
            return
        at = np.float32(now - self._began)
        self._trail.append((now, pose.x, pose.y))
        cells = self._hits(scan)
        for one in self._heard.values():
            reach = float(np.hypot(*one.word.outline.T).max()) + _APART + _SPEED * max(0.0, now - one.at)
            if now - one.at <= self._params.robots_last:
                cells = cells[self._distance(cells, one.word.pose) > reach]
        self._marked[cells[:, 0], cells[:, 1]] = at
        theirs, _ = self._theirs(now)
        if not len(theirs):
            return
        self._scratch.fill(UNKNOWN)
        self._scratch[theirs[:, 0], theirs[:, 1]] = LETHAL
        mark_and_clear(self._scratch, self._static.resolution, self._static.origin, scan, self._clears)
        free = theirs[self._scratch[theirs[:, 0], theirs[:, 1]] == FREE]
        self._cleared[free[:, 0], free[:, 1]] = at

    def costs(self, now: float, pose: Pose) -> Costs | None:
        """A layer on the map's cells: lethal where others see something, or are; unknown elsewhere. None: nowhere."""
        if not self._params.listen or self._away is None or not self._heard:
            return None
        cells, seen = self._theirs(now)
        cells = cells[seen - self._began > self._cleared[cells[:, 0], cells[:, 1]]]
        away = self._distance(cells, pose)
        cells = cells[(away > self._reach + self._static.resolution) & (away <= self._params.reach)]
        if not len(cells):
            return None
        layer = np.full_like(self._static.costs, UNKNOWN)
        layer[cells[:, 0], cells[:, 1]] = LETHAL
        return layer

    def word(self, now: float, pose: Pose, marks: Costs) -> str | None:
        """What to tell the others; None: there is nobody to tell.

        Args:
            now: [s].
            pose: Of this robot on the map.
            marks: What its laser saw, on the map's cells.
        """
        if not self._params.tell or self._away is None or not self.is_listening(now):
            return None
        cells = np.argwhere((marks == LETHAL) & self._away)
        ages = now - self._began - self._marked[cells[:, 0], cells[:, 1]].astype(np.float64)
        told = ages <= self._params.obstacles_last
        return write_word(self._id, Word(pose, self._outline, cells[told], np.maximum(ages[told], 0.0)))

    def _prepare(self, now: float) -> None:
        """Room for what is known of each cell; only a robot in a group needs it."""
        static = self._static
        walls = (static.costs == LETHAL).astype(np.uint8)
        size = 2 * math.ceil(_BESIDE / static.resolution) + 1
        near = cv2.dilate(walls, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
        self._away = (static.costs == FREE) & (near == 0)
        self._began = now
        self._marked = np.full(static.costs.shape, -np.inf, dtype=np.float32)
        self._cleared = self._marked.copy()
        self._scratch = np.empty_like(static.costs)

    def _theirs(self, now: float) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """All cells that the others tell of and that are young enough, n by 2, and when each was seen."""
        cells, seen = [np.empty((0, 2), dtype=np.intp)], [np.empty(0)]
        for one in self._heard.values():
            young = now - one.seen <= self._params.obstacles_last
            cells.append(one.word.cells[young])
            seen.append(one.seen[young])
            if now - one.at <= self._params.robots_last:
                cells.append(one.body)
                seen.append(np.full(len(one.body), one.at))
        return np.concatenate(cells), np.concatenate(seen)

    def _without_me(self, one: _Heard) -> _Heard:
        """Without what was this robot itself, where it was when the other saw that."""
        if not self._trail or not len(one.seen):
            return one
        times, x, y = np.array(self._trail).T
        nearest = np.clip(np.searchsorted(times, one.seen), 0, len(times) - 1)
        centers = self._centers(one.word.cells)
        away = np.hypot(centers[:, 0] - x[nearest], centers[:, 1] - y[nearest])
        others = away > self._reach + _APART + _SPEED * _SURELY
        word = replace(one.word, cells=one.word.cells[others], ages=one.word.ages[others])
        return replace(one, word=word, seen=one.seen[others])

    def _below(self, word: Word) -> NDArray[np.intp]:
        """Cells of the map below a robot, n by 2."""
        static, pose = self._static, word.pose
        cos, sin = math.cos(pose.yaw), math.sin(pose.yaw)
        corners = word.outline @ np.array([[cos, sin], [-sin, cos]]) + (pose.x, pose.y)
        at = np.floor((corners - static.origin) / static.resolution).astype(np.int64)
        low = at.min(axis=0)
        width, height = at.max(axis=0) - low + 1
        mask = np.zeros((int(height), int(width)), dtype=np.uint8)
        cv2.fillPoly(mask, [(at - low).astype(np.int32)], 1)
        cells = np.argwhere(mask) + low[::-1]
        rows, columns = static.costs.shape
        inside = (cells >= 0).all(axis=1) & (cells[:, 0] < rows) & (cells[:, 1] < columns)
        return cast(NDArray[np.intp], cells[inside].astype(np.intp))

    def _hits(self, scan: Scan) -> NDArray[np.intp]:
        """Cells in which rays ended, as far as they are marked, n by 2."""
        ranges = scan.ranges.astype(np.float64)
        with np.errstate(invalid="ignore"):
            hit = (ranges > scan.range_min) & (ranges < scan.range_max) & (ranges <= self._mark_range)
        angles = scan.sensor.yaw + scan.angle_min + scan.angle_increment * np.flatnonzero(hit)
        x = scan.sensor.x + ranges[hit] * np.cos(angles) - self._static.origin[0]
        y = scan.sensor.y + ranges[hit] * np.sin(angles) - self._static.origin[1]
        cells = np.floor(np.column_stack((y, x)) / self._static.resolution)
        rows, columns = self._static.costs.shape
        inside = (cells >= 0).all(axis=1) & (cells[:, 0] < rows) & (cells[:, 1] < columns)
        return cast(NDArray[np.intp], cells[inside].astype(np.intp))

    def _centers(self, cells: NDArray[np.intp]) -> NDArray[np.float64]:
        """X and y of cells, n by 2 [m]."""
        return cast(NDArray[np.float64], (cells[:, ::-1] + 0.5) * self._static.resolution + self._static.origin)

    def _distance(self, cells: NDArray[np.intp], pose: Pose) -> NDArray[np.float64]:
        """Of cells from a pose [m]."""
        centers = self._centers(cells)
        return np.hypot(centers[:, 0] - pose.x, centers[:, 1] - pose.y)


def outline(footprint: Footprint) -> NDArray[np.float64]:
    """Corners of a robot's outline, without padding, n by 2 [m]; of a circle, or of one with many, those around it."""
    if 3 <= len(footprint.corners) <= MOST_CORNERS:
        return np.array(footprint.corners)
    angles = 2 * math.pi * np.arange(MOST_CORNERS) / MOST_CORNERS
    # Around the circle, not within it.
    radius = (footprint.circumscribed - footprint.padding) / math.cos(math.pi / MOST_CORNERS)
    return radius * np.column_stack((np.cos(angles), np.sin(angles)))
