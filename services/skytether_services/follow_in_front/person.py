"""One person, or what may be one: where they are and how they walk, and what speaks for their being a person."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_ACCELERATION = 1.5
"""How hard people change their walk, m/s^1.5 (square root of the power density of white acceleration)."""
_TWO_LEGS = 0.06
"""Standard deviation of the middle of two legs about the person's, m."""
_ONE_LEG = 0.25
"""Of one leg that is seen alone, m: a foot rests for half a second while the person goes on, and is no white noise."""
_SHADOW = 0.12
"""What is this near to the line from the laser through a leg, and behind it, is hidden by it, m."""
_HIDDEN = 0.75
"""A leg so hidden is thought to be where it was; of what the person goes, this share goes to the middle's deviation."""
_BORN = (0.15, 0.8)
"""Standard deviations of place [m] and of each velocity [m/s] of one who was just found."""
_WEIGHT = 0.12
"""Of the newest scan in the share of legs seen."""
_ONE = 0.5
"""What one leg counts in it."""


@dataclass(frozen=True, slots=True)
class Proof:
    """What makes a person of a track.

    Attributes:
        scans: Since the track began, at the least.
        way: Who has gone so far from where they last rested walks [m].
        speed: At no less than this on the whole [m/s]: what odometry or a wandering edge makes is slower.
        slow_speed: The same of one whose two legs are seen apart in most scans [m/s]: no edge has two that go together.
        apart: So many of the scans are most.
        seen: Share of the scans in which a walker was seen.
        walker_legs: Share of legs seen of one who walks, 0 to 1 (both in all scans).
        pair_scans: One who stands: so many scans, of which 60 % with both legs.
        pair_legs: The same share, of one who stands.
        pair_seen: Share of the scans in which one who stands was seen.
        pair_trust: One who has stood for longer than this, and never walked, is furniture [s].
    """

    scans: int = 4
    way: float = 0.6
    speed: float = 0.6
    slow_speed: float = 0.15
    apart: float = 0.6
    seen: float = 0.7
    walker_legs: float = 0.35
    pair_scans: int = 5
    pair_legs: float = 0.62
    pair_seen: float = 0.8
    pair_trust: float = 6.0


_PROOF = Proof()
_REST = (0.25, 2.0)
"""Who has not left a place by so much [m] for so long [s] rests there: a walk begins anew."""


@dataclass(slots=True, eq=False)
class Person:
    """A track: constant velocity, disturbed by white acceleration (Bar-Shalom et al. 2001, section 6.2.2).

    Attributes:
        id: Never used twice.
        state: x, y [m], vx, vy [m/s] in a frame that does not move.
        covariance: Of it.
        born_at: When the track began [s].
        seen_at: When a leg of it was last seen [s].
        walks: It has walked: a thing does not.
        stands: Both legs were seen for a while, and it has not walked yet.
        legs: Seen in the last scan: 0, 1 or 2.
        mixed_at: When the track of another person ended in this one: since then it may be either [s].
    """

    id: int
    state: Floats
    covariance: Floats
    born_at: float
    seen_at: float
    walks: bool = False
    stands: bool = False
    legs: int = 0
    mixed_at: float = -math.inf
    _feet: Floats | None = None
    _feet_at: float = 0.0
    _rested: Floats = field(default_factory=lambda: np.zeros(2))
    _rested_at: float = 0.0
    _scans: int = 0
    _seen: int = 0
    _full: int = 0
    _apart: int = 0
    _share: float = 0.5
    _furthest: float = 0.0
    _proof: Proof = field(default_factory=Proof)

    @classmethod
    def at(cls, number: int, place: Floats, now: float, proof: Proof = _PROOF) -> Person:
        """One who was just found at a place [m], and is a person by this proof."""
        covariance = np.diag([_BORN[0] ** 2] * 2 + [_BORN[1] ** 2] * 2)
        rested = np.array(place, np.float64)
        state = np.array([*place, 0.0, 0.0])
        return cls(number, state, covariance, now, now, _rested=rested, _rested_at=now, _proof=proof)

    @property
    def place(self) -> Floats:
        """(x, y) [m]."""
        return self.state[:2]

    @property
    def velocity(self) -> Floats:
        """(vx, vy) [m/s]."""
        return self.state[2:]

    @property
    def known(self) -> bool:
        """Whether it is taken for a person."""
        return self.walks or self.stands

    @property
    def paired(self) -> bool:
        """Whether both legs are seen, and have been for a while: so a person stands, and a chair."""
        p = self._proof
        enough = self._scans >= p.pair_scans and self._full >= 0.6 * p.pair_scans
        return enough and self._share >= p.pair_legs and self._seen / self._scans >= p.pair_seen

    @property
    def share(self) -> float:
        """Of legs seen lately, 0 to 1."""
        return self._share

    @property
    def spread(self) -> float:
        """Standard deviation of the place [m]."""
        return math.sqrt((self.covariance[0, 0] + self.covariance[1, 1]) / 2)

    def predict(self, dt: float) -> None:
        """Walk on for dt seconds."""
        q = _ACCELERATION**2
        move = np.eye(4)
        move[0, 2] = move[1, 3] = dt
        noise = np.zeros((4, 4))
        for axis in (0, 1):
            noise[axis, axis] = q * dt**3 / 3
            noise[axis, axis + 2] = noise[axis + 2, axis] = q * dt**2 / 2
            noise[axis + 2, axis + 2] = q * dt
        self.state = move @ self.state
        self.covariance = move @ self.covariance @ move.T + noise

    def update(self, legs: Floats, full: bool, now: float, laser: tuple[float, float]) -> None:
        """Take what a scan showed of it.

        Args:
            legs: n by (x, y) [m]; n is 0, 1 or 2.
            full: Both legs are in it, be it in one cluster.
            now: When [s].
            laser: Where it was [m].
        """
        self._scans += 1
        self.legs = 2 if full else len(legs)
        self._share += _WEIGHT * ((1.0 if full else _ONE if len(legs) else 0.0) - self._share)
        if len(legs):
            self._correct(*self._middle(legs, full, now, laser))
            self.seen_at = now
            self._seen += 1
            self._full += full
            self._apart += len(legs) == 2
        self._furthest = max(self._furthest, math.dist(self.place, self._rested))
        if self._furthest < _REST[0] and now - self._rested_at > _REST[1]:
            self._rested, self._rested_at, self._furthest = self.place.copy(), now, 0.0
        if self.legs:
            self.walks = self.walks or (self._scans >= self._proof.scans and self._has_walked(now))
            self.stands = self.stands or self.paired
        self.stands = self.stands and not self.walks and now - self.born_at <= self._proof.pair_trust

    def _middle(self, legs: Floats, full: bool, now: float, laser: tuple[float, float]) -> tuple[Floats, float]:
        """Where the middle of both legs is, with its deviation [m].

        A leg that the other one hides rests there at first: it was hidden by a step of the other.
        """
        if full:
            self._feet, self._feet_at = (legs.copy(), now) if len(legs) == 2 else (None, now)
            return legs.mean(axis=0), _TWO_LEGS
        gone = math.hypot(*self.velocity.tolist()) * (now - self._feet_at)
        deviation = math.hypot(_TWO_LEGS, _HIDDEN * gone)
        if self._feet is not None and deviation < _ONE_LEG:
            other = self._feet[int(np.argmax(np.hypot(*(self._feet - legs[0]).T)))]
            if _hides(legs[0] - laser, other - laser):
                return (legs[0] + other) / 2, deviation
        return legs.mean(axis=0), _ONE_LEG

    def _correct(self, place: Floats, deviation: float) -> None:
        innovation = self.covariance[:2, :2] + np.eye(2) * deviation**2
        gain = self.covariance[:, :2] @ np.linalg.inv(innovation)
        self.state = self.state + gain @ (place - self.state[:2])
        self.covariance = self.covariance - gain @ self.covariance[:2, :]

    def _has_walked(self, now: float) -> bool:
        p = self._proof
        pace = p.slow_speed if self._apart >= p.apart * self._scans else p.speed
        far = self._furthest >= max(p.way, pace * (now - self._rested_at))
        return far and self._seen >= p.seen * self._scans and self._share >= p.walker_legs


def _hides(leg: Floats, other: Floats) -> bool:
    """Whether a leg stands before another, as the laser at the origin sees them [m]."""
    away = math.hypot(*leg.tolist())
    beside = abs(float(leg[0] * other[1] - leg[1] * other[0])) / max(away, 1e-6)
    return beside < _SHADOW and math.hypot(*other.tolist()) > away
