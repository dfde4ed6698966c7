"""From scans to commands: legs, operator and law together, over a link, with made-up time."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import pytest
from follow_plant import LAG
from leg_scans import FIRST, LIMITS, STEP, feet, scan

from skytether_services.follow_in_front.formation import Formation, FormationParams, State
from skytether_services.follow_in_front.operator import OperatorChoice, OperatorState
from skytether_services.follow_in_front.tracker import PeopleTracker

PERIOD = 0.1


@pytest.mark.slow
@pytest.mark.parametrize("round_trip", [0.0, 0.3])
def test_the_robot_stays_ahead_of_one_person_and_minds_no_other(round_trip: float) -> None:
    """The operator comes up and walks on at 0.45 m/s; a stranger overtakes both, 1 m aside."""
    random = np.random.default_rng(4)
    tracker, choice = PeopleTracker(), OperatorChoice()
    formation = Formation(FormationParams(lead=round_trip / 2 + LAG))
    late = round(round_trip / 2 / PERIOD)
    up: deque[tuple[float, float, float, float, float] | None] = deque([None] * late)
    down = deque([0.0] * late)
    x = v = 0.0
    operator_x, way = -2.0, 0.0
    distances, states, followed = [], [], []
    for number in range(180):
        now = number * PERIOD
        stranger = (-6.0 + 0.9 * now, 1.0)
        ranges = scan(
            feet((operator_x, 0.0), 0.0, way) + feet(stranger, 0.0, 0.9 * now),
            [((-9.0, 3.0), (20.0, 3.0))],
            (x - 0.2, 0.0, math.pi),
            random,
        )
        tracker.step(ranges, FIRST, STEP, LIMITS, (x - 0.2, 0.0, math.pi), now)
        operator = choice.step(tracker.tracks, (x, 0.0, 0.0), now)
        seen = (operator.x, operator.y, operator.vx, operator.vy, operator.seen_at) if operator else None
        up.append(seen)
        arrived = up.popleft()
        if arrived is not None:
            formation.legs(*arrived)
        formation.face(0.0, now - round_trip / 2)
        command = formation.step(now)
        down.append(command.velocity.linear)
        goal = down.popleft()
        v += (goal - v) * -math.expm1(-PERIOD / LAG)
        x += v * PERIOD
        operator_x, way = operator_x + 0.45 * PERIOD, way + 0.45 * PERIOD
        distances.append(x - operator_x)
        states.append(command.state)
        followed.append(operator)
    assert choice.picked == 1
    assert choice.choice == OperatorState.FOLLOWED
    assert states[-1] == State.FOLLOWING
    assert min(distances) > 0.55
    assert np.abs(np.array(distances[100:]) - 0.9).max() < 0.15
    # Always the operator, never the stranger, who is 1 m aside.
    assert all(abs(one.y) < 0.4 for one in followed if one is not None)
