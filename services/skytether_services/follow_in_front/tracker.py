"""All people about a robot, from scan to scan."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .assignment import assign, pairs
from .background import Background
from .clusters import clusters_of, rays_of
from .legs import both_legs, leg_like
from .person import Person, Proof

Floats = NDArray[np.float64]

_NEAREST = 0.35
"""What is nearer to the laser is the robot itself, m."""
_DEPTH = 0.03
"""From the middle of what a laser sees of a leg to the leg's own, m."""
_PAIR = 0.6
"""Legs of one who is found are this near to each other, m."""
_ROOM = 0.4
"""Nobody is found nearer to a track than this, m."""
_ROOM_KNOWN = 0.6
"""Nor to a person, whose other leg it may be, m."""
_OTHER_LEG = 0.5
"""Two tracks with a leg each that come this near to each other are one person's legs, m."""
_LEAST_SHARE = 0.1
"""Who shows fewer legs than this share is gone."""
_WALKING = 0.5
"""Whose foot is where something has long stood is not as fast, m/s."""
_LONG = 1.8
"""A foot rests for 0.6 of a stride, which is 1.2 s at 0.4 m/s and 1.5 s at 0.3 m/s; what stands for longer is none, s.

Who walks so slowly seems to be as fast as `_WALKING` with each step: the middle of both legs is, while one swings.
"""
_FASTEST = 3.0
"""What moves faster does not walk, m/s."""
_MOST = 60
"""Tracks at the same time, people or not; of clusters that look like legs the nearest twice as many count."""
_LONGEST = 1.0
"""After a longer time without a scan all is forgotten, s: people are elsewhere."""


_PROOF = Proof()


@dataclass(frozen=True, slots=True)
class TrackerParams:
    """How people are followed.

    Attributes:
        furthest: Legs are looked for within this distance of the laser [m].
        keep: A person of whom nothing is seen walks on for so long in mind [s].
        keep_new: What is not yet known to be a person, for so long [s].
        proof: What makes a person.
    """

    furthest: float = 8.0
    keep: float = 1.0
    keep_new: float = 0.35
    proof: Proof = _PROOF


_DEFAULT = TrackerParams()


class PeopleTracker:
    """Finds people in scans, and keeps them apart."""

    def __init__(self, params: TrackerParams = _DEFAULT) -> None:
        self._params = params
        self._background = Background()
        self._tracks: list[Person] = []
        self._next = 1
        self._at: float | None = None
        self.legs_seen = 0
        """Clusters that looked like a leg, or like two, in the last scan."""

    @property
    def tracks(self) -> tuple[Person, ...]:
        """All, whether they are people or not."""
        return tuple(self._tracks)

    @property
    def people(self) -> tuple[Person, ...]:
        """Those who are taken for people, hidden ones too (`Person.seen_at`)."""
        return tuple(person for person in self._tracks if person.known)

    def step(
        self,
        ranges: NDArray[np.floating],
        first: float,
        step: float,
        limits: tuple[float, float],
        laser: tuple[float, float, float],
        now: float,
    ) -> tuple[Person, ...]:
        """Take one scan.

        Args:
            ranges: [m]; what is outside the limits, infinite or NaN measured nothing.
            first: Angle of the first ray [rad].
            step: Between neighbouring rays [rad].
            limits: Smallest and largest range that means something [m].
            laser: Its pose in a frame that does not move: x [m], y [m], heading [rad].
            now: When the scan was made [s]. One that is not later than the last is ignored.

        Returns:
            `people`.
        """
        if self._at is not None and now <= self._at <= now + _LONGEST:
            return self.people
        if self._at is None or not 0 < now - self._at <= _LONGEST:
            self._tracks, self._background = [], Background()
            self._at = now
        for person in self._tracks:
            person.predict(now - self._at)
        self._at = now
        x, y, heading = laser
        turn = np.array([[math.cos(heading), math.sin(heading)], [-math.sin(heading), math.cos(heading)]])
        rays = rays_of(ranges, first, step, max(limits[0], _NEAREST), limits[1])
        clusters = clusters_of(rays, furthest=self._params.furthest)
        single, both = leg_like(clusters), both_legs(clusters)
        use = single | both
        if use.sum() > 2 * _MOST:
            use &= clusters.distances <= np.sort(clusters.distances[use])[2 * _MOST - 1]
        self.legs_seen = int(use.sum())
        # A laser sees the near half of a leg; its middle is further away.
        middles = clusters.middles * (1 + _DEPTH / np.maximum(clusters.distances, _NEAREST))[:, None]
        legs, both = middles[use] @ turn + (x, y), both[use]
        seen = clusters.middles[use] @ turn + (x, y)
        stand = np.array([self._background.stands(place, now) for place in seen], bool)
        long = np.array([self._background.stands(place, now, _LONG) for place in seen], bool)
        taken = self._give(legs, both, long, now, (x, y))
        self._tracks = [person for person in self._tracks if self._stays(person, now)]
        self._tracks = [person for person in self._tracks if not self._is_a_leg_of_another(person, now)]
        new = np.flatnonzero(~both & ~stand).tolist()
        self._find(legs, [leg for leg in new if leg not in taken], now)
        self._background.add(rays.points @ turn + (x, y), now)
        return self.people

    def _give(
        self,
        legs: Floats,
        both: NDArray[np.bool_],
        stand: NDArray[np.bool_],
        now: float,
        laser: tuple[float, float],
    ) -> set[int]:
        """Give legs to people; returns the legs that were given."""
        tracks = self._tracks
        places = np.array([person.place for person in tracks]).reshape(-1, 2)
        spreads = np.array([person.spread for person in tracks])
        known = np.array([person.known for person in tracks], bool)
        # A pillar takes the place of nobody who walks by.
        walking = np.array([math.hypot(*person.velocity.tolist()) > _WALKING for person in tracks], bool)
        impossible = walking[:, None] & stand[None, :]
        given: set[int] = set()
        for person, mine in zip(tracks, assign(places, spreads, known, legs, both, impossible), strict=True):
            full = len(mine) == 2 or (len(mine) == 1 and bool(both[mine[0]]))
            person.update(legs[mine], full, now, laser)
            given.update(mine)
        return given

    def _stays(self, person: Person, now: float) -> bool:
        keep = self._params.keep if person.known else self._params.keep_new
        return (
            now - person.seen_at <= keep
            and person.share > _LEAST_SHARE
            and math.hypot(*person.velocity.tolist()) < _FASTEST
        )

    def _is_a_leg_of_another(self, person: Person, now: float) -> bool:
        """Whether an older track of a person, with one leg in view or none, is so near that this is its other leg.

        If this one is a person, too, one of them may hide the other: that is noted.
        """
        if person.legs == 2:
            return False
        for other in self._tracks:
            near = math.dist(other.place, person.place) < _OTHER_LEG
            if other.id < person.id and other.known and other.legs < 2 and near:
                if person.known:
                    other.mixed_at = now
                return True
        return False

    def _find(self, legs: Floats, free: list[int], now: float) -> None:
        """Begin tracks with legs that are nobody's."""
        free = [
            leg
            for leg in free
            if all(
                math.dist(legs[leg], person.place) > (_ROOM_KNOWN if person.known else _ROOM) for person in self._tracks
            )
        ]
        for found in pairs(legs, free, _PAIR):
            if len(self._tracks) < _MOST:
                place = legs[list(found)].mean(axis=0)
                self._tracks.append(Person.at(self._next, place, now, self._params.proof))
                self._next += 1
