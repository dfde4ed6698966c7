"""Whom to follow: one of the people about the robot is picked, and kept until they are gone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .person import Person

OVER_LEGS = math.radians(14)
"""A face is this near to the direction of its legs: 0.2 m at 0.8 m, as far as one leans."""


class OperatorState(StrEnum):
    """How it stands with the operator.

    Attributes:
        NOBODY: Nobody stands where an operator does.
        SEVERAL: More than one does, or somebody came so near that one could be the other: the robot does not guess.
        FOLLOWED: There is one.
        LOST: There was one, who is not in sight; nobody else is taken for a while.
    """

    NOBODY = "nobody"
    SEVERAL = "several"
    FOLLOWED = "followed"
    LOST = "lost"


class Operator(NamedTuple):
    """Whom the robot follows.

    Attributes:
        id: Of the track; changes if a track was lost and the person found again.
        x: In the robot's frame, x ahead [m]; an operator is behind.
        y: To the left [m].
        vx: Velocity over the floor, along the robot's x [m/s].
        vy: Likewise, along its y [m/s].
        seen_at: When a leg was last seen [s].
    """

    id: int
    x: float
    y: float
    vx: float
    vy: float
    seen_at: float


@dataclass(frozen=True, slots=True)
class OperatorParams:
    """Where an operator stands, and for how long one is waited for.

    Attributes:
        near: Distance from the robot's middle at the least [m].
        far: At the most, to be picked [m].
        side: Off the line straight back at the most, to be picked [rad].
        apart: Of two who could be, one is picked only if this much nearer to that line than the other [m].
        settle: And only who has been the one to pick for so long [s]: of two who come up, one is seen to walk first.
        gone: Whoever is further away than this is followed no more [m].
        again: One who was lost is found again within this distance of where they would be [m].
        memory: And within this time after they were seen last [s]. Nobody else is picked meanwhile.
        under: One who only stood so far is a person if the only face in sight is this near to their direction [rad].
        close: Of somebody who is nearer than this to the operator nobody knows any more which of them is which [m].
        close_hidden: The same while not both legs of the operator are seen [m].
        close_scans: For so many scans in a row.
        appears: One who appears so near to the operator, and turns out to be a person, came out from behind them, or is
            the operator, who came out from behind somebody [m].
    """

    near: float = 0.4
    far: float = 2.0
    side: float = math.radians(35)
    apart: float = 0.4
    settle: float = 0.4
    gone: float = 3.5
    again: float = 0.6
    memory: float = 2.0
    under: float = OVER_LEGS
    close: float = 0.45
    close_hidden: float = 0.65
    close_scans: int = 2
    appears: float = 1.2


class _Last(NamedTuple):
    """The operator as of the last scan in which there was one.

    Attributes:
        id: Of the track.
        place: [m].
        velocity: [m/s].
        at: When that was [s].
        seen_at: When a leg was last seen [s]; before ``at`` if the operator was hidden.
    """

    id: int
    place: NDArray[np.float64]
    velocity: NDArray[np.float64]
    at: float
    seen_at: float

    def expected(self, now: float) -> NDArray[np.float64]:
        """Where they would be now [m]."""
        return self.place + self.velocity * (now - self.at)


_DEFAULT = OperatorParams()
_MOVES = 0.25
"""What moves faster may be one who is about to walk, m/s."""


class OperatorChoice:
    """Picks the operator and keeps them.

    Who only stands may be a chair: one is picked who has walked, or has a face above. A change of operator is
    never silent: `choice` leaves ``FOLLOWED`` for `OperatorParams.memory` at the least, and `picked` counts. Two who
    come so near to each other that a laser cannot tell whose legs are whose are not told apart: nobody is followed
    then, and one is picked anew.
    """

    def __init__(self, params: OperatorParams = _DEFAULT) -> None:
        self._params = params
        self._last: _Last | None = None
        self._next: tuple[int, float] | None = None
        self._others: set[int] = set()
        self._before: set[int] = set()
        self._appeared: set[int] = set()
        self._close = 0
        self._mixed_at = -math.inf
        self.choice = OperatorState.NOBODY
        """How it stands."""
        self.picked = 0
        """So many operators were picked so far."""

    def step(
        self, people: Sequence[Person], robot: tuple[float, float, float], now: float, *, face: float | None = None
    ) -> Operator | None:
        """Take the people of a scan.

        Args:
            people: All tracks (`PeopleTracker.tracks`), in a frame that does not move.
            robot: Pose of the robot in that frame: x [m], y [m], heading [rad].
            now: When the scan was made [s].
            face: Where the only face in sight is, off straight back, positive to the robot's left [rad]; None: there is
                none, or more than one.

        Returns:
            Whom to follow; None: `choice` says why.
        """
        kept = self._kept(people, robot, now)
        self._note_who_appears(kept, people)
        if self._is_mixed_up(kept, people, now):
            self._last, self._mixed_at, self._next = None, now, None
        if 0 <= now - self._mixed_at < self._params.memory:
            self.choice = OperatorState.SEVERAL
            return None
        if kept is None and self._last is not None and self._remembers(self._last, now):
            self.choice = OperatorState.LOST
            return None
        if kept is None:
            self._last = None
            kept = self._pick(people, robot, now, face)
        if kept is None:
            return None
        self._last = _Last(kept.id, kept.place.copy(), kept.velocity.copy(), now, kept.seen_at)
        self.choice = OperatorState.FOLLOWED
        self._others &= {person.id for person in people}
        if kept.legs:
            self._others |= {person.id for person in people if person.known and person.legs and person is not kept}
        return _seen_from(robot, kept)

    def _note_who_appears(self, kept: Person | None, people: Sequence[Person]) -> None:
        """Remember who was not there before and is near to the operator at once."""
        there = {person.id for person in people}
        new = [person for person in people if person.id not in self._before]
        self._before = there
        if kept is None:
            self._appeared.clear()
        else:
            near = {
                one.id for one in new if one is not kept and math.dist(one.place, kept.place) < self._params.appears
            }
            self._appeared = (self._appeared | near) & there

    def _is_mixed_up(self, kept: Person | None, people: Sequence[Person], now: float) -> bool:
        """Whether somebody came so near to the operator that one could have become the other."""
        p = self._params
        if self._last is None:
            self._close = 0
            return False
        place = kept.place if kept is not None else self._last.expected(now)
        if any(one.mixed_at > self._last.at and math.dist(one.place, place) < p.again for one in people):
            return True
        if any(one.known and one.id in self._appeared for one in people):
            return True
        limit = p.close if kept is not None and kept.legs == 2 else p.close_hidden
        close = kept is not None and any(
            other is not kept and other.known and math.dist(other.place, place) < limit for other in people
        )
        self._close = self._close + 1 if close else 0
        return self._close >= p.close_scans

    def _remembers(self, last: _Last, now: float) -> bool:
        return last.at <= now <= last.seen_at + self._params.memory

    def _kept(self, people: Sequence[Person], robot: tuple[float, float, float], now: float) -> Person | None:
        """The operator of the last scan, under the same number or another.

        Whoever was seen at the same time as the operator is somebody else, however near.
        """
        if self._last is None:
            return None
        last = self._last
        same = next((person for person in people if person.id == last.id), None)
        if same is None and self._remembers(last, now):
            expected = last.expected(now)
            near = [
                person
                for person in people
                if (person.known or person.paired) and math.dist(person.place, expected) <= self._params.again
            ]
            same = near[0] if len(near) == 1 and near[0].id not in self._others else None
        if same is None or math.dist(same.place, robot[:2]) > self._params.gone:
            return None
        return same

    def _pick(
        self, people: Sequence[Person], robot: tuple[float, float, float], now: float, face: float | None
    ) -> Person | None:
        p = self._params
        found: list[tuple[float, Person, bool]] = []
        for person in people:
            seen = _seen_from(robot, person)
            distance, off = math.hypot(seen.x, seen.y), math.atan2(seen.y, -seen.x)
            if not (p.near <= distance <= p.far and abs(off) <= p.side and person.legs):
                continue
            sure = person.walks or (face is not None and person.paired and abs(face - off) <= p.under)
            if sure or _perhaps(person):
                found.append((abs(seen.y), person, sure))
        found.sort(key=lambda one: one[0])
        self.choice = (
            OperatorState.SEVERAL if len(found) > 1 and any(sure for _, _, sure in found) else OperatorState.NOBODY
        )
        if not found or (len(found) > 1 and found[1][0] - found[0][0] < p.apart) or not found[0][2]:
            self._next = None
            return None
        person = found[0][1]
        if self._next is None or self._next[0] != person.id or not 0 <= now - self._next[1] <= p.memory:
            self._next = (person.id, now)
        if now - self._next[1] < p.settle:
            self.choice = OperatorState.NOBODY
            return None
        self.picked += 1
        self._next = None
        self._others.clear()
        return person


def _perhaps(person: Person) -> bool:
    """Whether it may be a person, so that nobody beside it is picked: one who stands or moves, be it a chair."""
    return person.stands or math.hypot(*person.velocity.tolist()) > _MOVES


def _seen_from(robot: tuple[float, float, float], person: Person) -> Operator:
    x, y, heading = robot
    cos, sin = math.cos(heading), math.sin(heading)
    dx, dy = (person.place - (x, y)).tolist()
    vx, vy = person.velocity.tolist()
    return Operator(
        person.id, cos * dx + sin * dy, cos * dy - sin * dx, cos * vx + sin * vy, cos * vy - sin * vx, person.seen_at
    )
