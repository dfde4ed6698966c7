"""CLEAR MOT: how well people are tracked, judged by where they truly were (Bernardin and Stiefelhagen 2008)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

Places = Mapping[int, tuple[float, float]]
"""(x, y) [m] by number."""

MATCH = 0.75
"""A track this near to a person may be of that person, m (Leigh et al., ICRA 2015, section V)."""


@dataclass(frozen=True, slots=True)
class Score:
    """Sums over all scans.

    Attributes:
        truths: People that were to be found.
        switches: Of them, found by another track than before.
        misses: Of them, not found.
        false_positives: Tracks that were nobody's.
        motp_m: Mean distance of those found [m]; None: none was.
    """

    truths: int
    switches: int
    misses: int
    false_positives: int
    motp_m: float | None

    @property
    def mota(self) -> float | None:
        """1 less the share of errors, 1 at best, without a bound below; None: there was nobody to find."""
        errors = self.switches + self.misses + self.false_positives
        return 1 - errors / self.truths if self.truths else None


def clear_mot(found: Sequence[Places], truth: Sequence[Places], *, match: float = MATCH) -> Score:
    """Compare tracks with the truth, scan by scan.

    Who was matched stays so as long as the two are near enough; the others are matched at the least distance in all.
    One who was not found for a while, and is found by another track then, counts as a switch.

    Args:
        found: Tracks of each scan.
        truth: People of each scan; both in one frame.
        match: Largest distance of a match [m].
    """
    last: dict[int, int] = {}
    truths = switches = misses = false_positives = 0
    distances: list[float] = []
    for tracks, people in zip(found, truth, strict=True):
        matches = {
            track: person
            for track, person in last.items()
            if track in tracks and person in people and math.dist(tracks[track], people[person]) < match
        }
        matches |= _match(
            {track: place for track, place in tracks.items() if track not in matches},
            {person: place for person, place in people.items() if person not in matches.values()},
            match,
        )
        truths += len(people)
        misses += len(people) - len(matches)
        false_positives += len(tracks) - len(matches)
        for track, person in matches.items():
            distances.append(math.dist(tracks[track], people[person]))
            before = last.get(track)
            switches += before != person if before is not None else person in last.values()
        kept = {t: p for t, p in last.items() if t not in matches and p not in matches.values()}
        last = kept | matches
    return Score(truths, switches, misses, false_positives, float(np.mean(distances)) if distances else None)


def _match(tracks: Places, people: Places, match: float) -> dict[int, int]:
    """Tracks to people, as many as can be, at the least distance in all."""
    if not tracks or not people:
        return {}
    names, numbers = list(tracks), list(people)
    apart = np.array([[math.dist(tracks[track], people[person]) for person in numbers] for track in names])
    rows, columns = linear_sum_assignment(np.where(apart < match, apart, 1e3 * match))
    return {
        names[row]: numbers[column] for row, column in zip(rows, columns, strict=True) if apart[row, column] < match
    }
