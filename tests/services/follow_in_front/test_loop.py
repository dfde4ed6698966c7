"""One round of the thesis's experiment (section 5.5.2) in made-up time: hall, operator, legs, choice and law."""

from __future__ import annotations

import math

import numpy as np
import pytest
from follow_loop import REAR, Loop

from skytether.lab.measures import kinematic_tracking_error
from skytether_services.follow_in_front.formation import State
from skytether_services.follow_in_front.operator import Choice

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("seed", "round_trip", "face_rate"), [(1, 0.0, 15.0), (2, 0.0, 5.0), (3, 0.15, 15.0), (4, 0.15, 5.0)]
)
def test_a_round_is_done_on_the_path_without_a_touch(seed: int, round_trip: float, face_rate: float) -> None:
    loop = Loop(seed, round_trip=round_trip, face_rate=face_rate)
    assert loop.run(90.0)
    assert not loop.world.contacts
    # The thesis: 0.12 to 0.17 m in 51 to 60 s.
    assert kinematic_tracking_error(loop.curve.distances(loop.path)) < 0.08
    assert 40 < loop.world.time - loop.begun < 65
    # One operator, followed all the time once they were picked, and seen where they are.
    assert loop.picked == 1
    assert set(loop.choices[20:]) == {Choice.FOLLOWED}
    assert set(loop.states[20:]) == {State.FOLLOWING}
    assert np.mean(loop.errors) < 0.08
    assert max(loop.errors) < 0.25
    # The face is in the picture, with a hand's breadth beside it.
    assert max(map(abs, loop.aside)) < REAR.camera_field / 2 - math.radians(8)


def test_the_operator_who_is_done_stands_and_so_does_the_robot() -> None:
    loop = Loop(1)
    assert loop.run(90.0)
    loop.go_on(4.0)
    assert abs(loop.robot.motion.forward) < 0.02
    away = math.dist(loop.robot.pose[:2], loop.operator.pose[:2])
    assert 0.7 < away < 1.1
    assert not loop.world.contacts
