import math
from itertools import pairwise

import numpy as np
import pytest

from skytether.lab.trail import Pose
from skytether.lab.world.cluttered import NoFieldError, field, shortest_way, way_length
from skytether.lab.world.plan import Box, Cylinder, Plan
from skytether.lab.world.robot import RobotParams


def gate(*cylinders: Cylinder) -> Plan:
    walls = (Box("right", 0.0, -2.05, 12.0, 0.1, wall=True), Box("left", 0.0, 2.05, 12.0, 0.1, wall=True))
    return Plan("gate", walls, cylinders, (Pose(-3.0, 0.0, 0.0),), (Pose(3.0, 0.0, 0.0),))


def test_the_way_around_one_pole_is_nearly_the_tangents() -> None:
    way = shortest_way(gate(Cylinder("pole", 0.0, 0.0, 0.5)), 0.5)
    assert way is not None
    # Around a circle of 1 m radius from 3 m before its middle to 3 m behind it: two tangents of sqrt(8) m, and the arc
    # between them: pi - 2 acos(1/3).
    exact = 2 * math.sqrt(8) + math.pi - 2 * math.acos(1 / 3)
    assert exact <= way_length(way) <= exact * 1.03


def test_without_obstacles_it_is_straight_and_a_closed_gate_has_none() -> None:
    assert shortest_way(gate(), 0.4) == ((-3.0, 0.0), (3.0, 0.0))
    poles = [Cylinder(f"pole-{i}", 0.0, y, 0.1) for i, y in enumerate(np.arange(-2.0, 2.1, 0.5))]
    assert shortest_way(gate(*poles), 0.4) is None


def test_a_field_has_a_free_way_that_is_not_straight() -> None:
    made = field(10)
    assert made == field(10)
    assert made != field(10, seed=2)
    assert made.clearance == RobotParams().circumscribed
    ends = made.plan.starts[0], made.plan.goals[0]
    assert made.way[0] == ends[0][:2]
    assert made.way[-1] == ends[1][:2]
    assert made.length > math.dist(*(pose[:2] for pose in ends))
    line = np.concatenate([np.linspace(a, b, 100) for a, b in pairwise(made.way)])
    assert made.plan.clearance(line).min() > made.clearance - 2e-3
    # Nothing of it is in a map.
    assert made.plan.cylinders
    assert not any(pole.mapped for pole in made.plan.cylinders)


def test_wrong_numbers_and_robots_that_fit_nowhere_are_refused() -> None:
    with pytest.raises(ValueError, match="0 to 49, not 50"):
        field(50)
    with pytest.raises(NoFieldError, match=r"radius was found in 3 tries"):
        field(0, clearance=2.3, tries=3)


@pytest.mark.slow
def test_all_fifty_worlds_have_a_way_and_get_denser() -> None:
    worlds = [field(number) for number in range(50)]
    poles = [len(made.plan.cylinders) for made in worlds]
    assert np.mean(poles[40:]) > 2 * np.mean(poles[:10])
    assert all(9.0 < made.length < 20.0 for made in worlds)
