"""Who is followed, and that nobody else is, silently."""

from __future__ import annotations

import math

import numpy as np
import pytest

from skytether_services.follow_in_front.operator import OperatorChoice, OperatorParams, OperatorState
from skytether_services.follow_in_front.person import Person

ORIGIN = (0.0, 0.0, 0.0)
AT_ONCE = OperatorParams(settle=0.0)


def person(
    number: int, x: float, y: float, *, walks: bool = True, velocity: tuple[float, float] = (0.0, 0.0)
) -> Person:
    found = Person.at(number, np.array([x, y]), 0.0)
    found.state[2:] = velocity
    found.legs = 2
    if walks:
        found.walks = True
    else:
        for scan in range(10):  # both legs, always there
            found.update(np.array([(x, y - 0.12), (x, y + 0.12)]), True, 0.1 * scan, (0.0, 0.0))
    return found


def test_one_who_stands_behind_and_has_walked_is_picked() -> None:
    choice = OperatorChoice(AT_ONCE)
    operator = choice.step([person(3, -1.0, 0.1)], ORIGIN, 0.0)
    assert operator is not None
    assert (operator.id, operator.x, operator.y) == (3, pytest.approx(-1.0), pytest.approx(0.1))
    assert (choice.choice, choice.picked) == (OperatorState.FOLLOWED, 1)


@pytest.mark.parametrize(("x", "y"), [(1.0, 0.0), (-0.2, 0.0), (-3.0, 0.0), (-1.0, 1.0)])
def test_who_is_not_behind_or_too_near_or_too_far_is_not_picked(x: float, y: float) -> None:
    choice = OperatorChoice(AT_ONCE)
    assert choice.step([person(3, x, y)], ORIGIN, 0.0) is None
    assert (choice.choice, choice.picked) == (OperatorState.NOBODY, 0)


def test_place_and_velocity_are_told_in_the_robots_frame() -> None:
    # The robot looks along y; the person stands 1 m behind it and walks along y, which is ahead.
    operator = OperatorChoice(AT_ONCE).step([person(1, 2.0, 1.0, velocity=(0.0, 0.5))], (2.0, 2.0, math.pi / 2), 0.0)
    assert operator is not None
    assert (operator.x, operator.y) == (pytest.approx(-1.0), pytest.approx(0.0))
    assert (operator.vx, operator.vy) == (pytest.approx(0.5), pytest.approx(0.0))


def test_legs_that_never_walked_need_a_face() -> None:
    chair = person(2, -1.0, 0.0, walks=False)
    choice = OperatorChoice(AT_ONCE)
    assert choice.step([chair], ORIGIN, 0.0) is None
    assert choice.step([chair], ORIGIN, 0.1, face=0.3) is None, "of somebody beside it"
    operator = choice.step([chair], ORIGIN, 0.2, face=0.1)
    assert operator is not None


def test_of_two_who_could_be_none_is_guessed() -> None:
    choice = OperatorChoice(AT_ONCE)
    left, right = person(1, -1.0, 0.3), person(2, -1.0, -0.3)
    assert choice.step([left, right], ORIGIN, 0.0) is None
    assert choice.choice == OperatorState.SEVERAL
    # One far off the line is no doubt.
    operator = choice.step([person(1, -1.0, 0.05), person(2, -1.2, -0.7)], ORIGIN, 0.1)
    assert operator is not None
    assert operator.id == 1


def test_of_two_who_come_up_the_one_who_is_seen_to_walk_first_is_not_picked() -> None:
    choice = OperatorChoice()
    late = person(2, -1.0, -0.3)
    late.walks = False
    late.stands = False
    for scan in range(3):
        assert choice.step([person(1, -1.0, 0.3), late], ORIGIN, 0.1 * scan) is None
    late.walks = True
    assert choice.step([person(1, -1.0, 0.3), late], ORIGIN, 0.3) is None
    assert (choice.choice, choice.picked) == (OperatorState.SEVERAL, 0)
    for scan in range(4, 9):
        alone = choice.step([person(1, -1.0, 0.3)], ORIGIN, 0.1 * scan)
    assert alone is not None


def test_beside_one_who_may_be_about_to_walk_nobody_is_picked() -> None:
    moving = person(2, -1.0, -0.3, velocity=(0.5, 0.0))
    moving.walks = False
    choice = OperatorChoice(AT_ONCE)
    assert choice.step([person(1, -1.0, 0.3), moving], ORIGIN, 0.0) is None
    assert choice.choice == OperatorState.SEVERAL


def test_the_operator_stays_though_others_come_nearer() -> None:
    choice = OperatorChoice(AT_ONCE)
    choice.step([person(9, 1.5, 0.0), person(1, -1.0, 0.2)], ORIGIN, 0.0)
    for scan in range(1, 20):
        operator = choice.step([person(9, -0.6, -0.2), person(1, -1.0, 0.2 + 0.05 * scan)], ORIGIN, 0.1 * scan)
        assert operator is not None
        assert operator.id == 1
    assert choice.picked == 1


def test_one_who_appears_beside_the_operator_may_be_the_operator() -> None:
    choice = OperatorChoice(AT_ONCE)
    choice.step([person(1, -1.0, 0.0)], ORIGIN, 0.0)
    something, other = person(2, -1.4, 0.7, walks=False), person(1, -1.0, 0.0)
    something.stands = False
    assert choice.step([something, other], ORIGIN, 0.1) is not None, "it may be a chair"
    something.walks = True
    assert choice.step([something, other], ORIGIN, 0.2) is None
    assert choice.choice == OperatorState.SEVERAL
    assert choice.step([other], ORIGIN, 2.1) is None
    assert choice.step([other], ORIGIN, 2.3) is not None
    assert choice.picked == 2


def test_one_who_is_lost_is_found_again_where_they_would_be() -> None:
    choice = OperatorChoice(AT_ONCE)
    choice.step([person(1, -1.0, 0.0, velocity=(0.4, 0.0))], ORIGIN, 0.0)
    assert choice.step([], ORIGIN, 0.5) is None
    assert choice.choice == OperatorState.LOST
    # After 1 s at 0.4 m/s they are at -0.6; the track has a new number.
    operator = choice.step([person(5, -0.65, 0.1)], ORIGIN, 1.0)
    assert operator is not None
    assert operator.id == 5
    assert choice.picked == 1, "the same operator"


def test_nobody_takes_the_place_of_one_who_is_lost_at_once() -> None:
    choice = OperatorChoice(AT_ONCE)
    choice.step([person(1, -1.5, 0.0)], ORIGIN, 0.0)
    stranger = person(2, -0.8, 0.1)  # 0.7 m from where the operator was
    for at in (0.1, 1.0, 2.0):
        assert choice.step([stranger], ORIGIN, at) is None
        assert choice.choice == OperatorState.LOST
    assert choice.step([stranger], ORIGIN, 2.1) is not None
    assert choice.picked == 2, "another one, and it is counted"


def test_of_two_who_might_be_the_lost_one_none_is_guessed() -> None:
    choice = OperatorChoice(AT_ONCE)
    choice.step([person(1, -1.0, 0.0)], ORIGIN, 0.0)
    assert choice.step([person(2, -1.0, 0.3), person(3, -1.0, -0.3)], ORIGIN, 0.5) is None
    assert choice.choice == OperatorState.LOST


def test_one_who_walks_away_is_not_followed() -> None:
    choice = OperatorChoice(AT_ONCE)
    choice.step([person(1, -1.0, 0.0)], ORIGIN, 0.0)
    assert choice.step([person(1, -3.6, 0.0)], ORIGIN, 0.1) is None
    assert choice.choice == OperatorState.LOST
    assert choice.step([person(1, -3.6, 0.0)], ORIGIN, 2.5) is None
    assert choice.choice == OperatorState.NOBODY


def test_a_clock_that_was_set_back_makes_nobody_lost_for_ever() -> None:
    choice = OperatorChoice(AT_ONCE)
    choice.step([person(1, -1.0, 0.0)], ORIGIN, 1000.0)
    choice.step([], ORIGIN, 1.0)
    assert choice.choice == OperatorState.NOBODY
    assert choice.step([person(2, -1.0, 0.0)], ORIGIN, 1.1) is not None
