"""Lists of goals: their order, rounds, and where the robot stands."""

import math

import pytest

from skytether_services.navigation.status import Code
from skytether_services.navigation.task import MAX_GOALS, Task, refusal
from skytether_services.planar.geometry import Pose

A, B, C = (Pose(float(i), 0.0, 0.0) for i in range(3))


def driven(task: Task, most: int = 10) -> list[tuple[int, int, bool]]:
    found = []
    following: Task | None = task
    while following is not None and len(found) < most:
        found.append((following.round, following.index, following.stops))
        following = following.following()
    return found


def test_a_list_is_driven_once() -> None:
    assert driven(Task((A, B))) == [(1, 0, True), (1, 1, True)]


def test_a_route_repeats() -> None:
    assert driven(Task((A, B), rounds=2)) == [(1, 0, True), (1, 1, True), (2, 0, True), (2, 1, True)]
    assert len(driven(Task((A,), rounds=0))) == 10


def test_through_poses_it_stands_at_the_last_only() -> None:
    assert driven(Task((A, B, C), stop_at_each=False)) == [(1, 0, False), (1, 1, False), (1, 2, True)]
    assert Task((A, B, C), stop_at_each=False).until_stop(5) == (A, B, C)
    assert Task((A, B, C), stop_at_each=False).until_stop(2) == (A, B)
    assert Task((A, B, C)).until_stop(5) == (A,)
    # Again and again, without a stand.
    assert Task((A, B), rounds=0, stop_at_each=False, index=1).until_stop(3) == (B, A, B)


@pytest.mark.parametrize(
    ("goals", "code"),
    [([], Code.NO_GOALS), ([A, Pose(math.inf, 0.0, 0.0)], Code.BAD_GOAL), ([A] * (MAX_GOALS + 1), Code.BAD_GOAL)],
)
def test_what_is_no_list_of_goals_is_refused(goals: list[Pose], code: Code) -> None:
    assert refusal(goals).code is code
    assert refusal([A, B]) is None
