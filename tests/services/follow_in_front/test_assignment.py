"""Legs are given to people at the least cost in all: compared with trying every way."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from skytether_services.follow_in_front.assignment import assign, pairs


def give(
    people: list[tuple[float, float]], legs: list[tuple[float, float]], both: tuple[int, ...] = ()
) -> list[list[int]]:
    count = len(people)
    twins = np.array([leg in both for leg in range(len(legs))], bool)
    return assign(
        np.array(people).reshape(-1, 2),
        np.full(count, 0.1),
        np.ones(count, bool),
        np.array(legs).reshape(-1, 2),
        twins,
        np.zeros((count, len(legs)), bool),
    )


def test_each_gets_their_own_two_legs() -> None:
    assert give([(0, 0), (1, 0)], [(0.9, 0.1), (0.1, 0), (-0.1, 0), (1.1, 0)]) == [[1, 2], [0, 3]]


def test_a_leg_that_hides_the_other_is_enough() -> None:
    assert give([(0, 0), (1, 0)], [(0.1, 0), (0.9, 0), (1.1, 0)]) == [[0], [1, 2]]
    assert give([(0, 0)], []) == [[]]
    assert give([], [(0, 0)]) == []


def test_between_two_people_a_leg_goes_to_the_one_who_lacks_it() -> None:
    # The leg in the middle is a little nearer to the first, who has one; the second would have none.
    assert give([(0, 0), (0.8, 0)], [(-0.1, 0), (0.39, 0)]) == [[0], [1]]


def test_legs_too_far_apart_or_touching_are_not_two() -> None:
    assert give([(0, 0)], [(0.44, 0), (-0.44, 0)]) in ([[0]], [[1]])
    assert give([(0, 0)], [(0.1, 0), (0.3, 0)], both=(0,)) == [[0]]


def test_an_impossible_leg_is_not_given() -> None:
    people, legs = np.zeros((1, 2)), np.array([(0.1, 0.0), (0.2, 0.0)])
    impossible = np.array([[True, False]])
    known, both = np.ones(1, bool), np.zeros(2, bool)
    assert assign(people, np.array([0.1]), known, legs, both, impossible) == [[1]]


@pytest.mark.parametrize("seed", range(8))
def test_no_other_way_costs_less(seed: int) -> None:
    random = np.random.default_rng(seed)
    # Within 0.6 by 0.6 m no two legs are further apart than a stride.
    people, legs = random.uniform(0, 0.6, (3, 2)), random.uniform(0, 0.6, (4, 2))

    def cost(way: tuple[int, ...]) -> float:
        """Of giving each leg to this person, or to nobody (3); infinite if it may not be. From the page's own rules."""
        total, held = 0.0, [0, 0, 0]
        for leg, person in enumerate(way):
            if person == 3:
                continue
            apart, spread = float(np.hypot(*(people[person] - legs[leg]))), float(np.hypot(0.1, 0.18))
            if apart > min(3 * spread, 0.6) or held[person] == 2:
                return np.inf
            total += (apart / spread) ** 2 + (1.0 if held[person] else 0.0)
            held[person] += 1
        return total + 12.0 * (6 - sum(held))

    best = min(cost(way) for way in product(range(4), repeat=4))
    found = assign(people, np.full(3, 0.1), np.ones(3, bool), legs, np.zeros(4, bool), np.zeros((3, 4), bool))
    way = [3] * 4
    for person, mine in enumerate(found):
        for leg in mine:
            way[leg] = person
    assert cost(tuple(way)) == pytest.approx(best)


def test_the_nearest_are_paired_first() -> None:
    legs = np.array([(0.0, 0.0), (0.3, 0.0), (0.45, 0.0), (3.0, 0.0)])
    assert pairs(legs, [0, 1, 2, 3], 0.6) == [(1, 2), (0,), (3,)]
    assert pairs(legs, [], 0.6) == []
