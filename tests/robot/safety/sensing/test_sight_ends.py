"""Where the sight of several sensors ends."""

import numpy as np

from skytether.robot.safety.sensing.coverage import CELLS, Action, Cover
from skytether.robot.safety.sensing.sensing import Part, Scene


def part(far: float, *edge: tuple[float, float], first: float = 0.0) -> Part:
    """A sensor at the origin that looks into the cells from that share of a turn on."""
    reach = np.where(np.arange(CELLS) >= first * CELLS, np.inf, 0.0)
    return Part(np.empty((0, 2)), np.array(edge).reshape(-1, 2), 0.0, Cover(0.0, 0.0, 0.0, 1.0, reach), far)


def edge(*parts: Part) -> list[list[float]]:
    return Scene(parts, Action.FREE, False, {}).edge.tolist()


def test_one_sensor_ends_where_it_ends():
    assert edge(part(3.0, (3.0, 0.0))) == [[3.0, 0.0]]
    assert edge() == []


def test_the_sonars_end_is_none_where_a_laser_looks_farther():
    sonar = part(2.0, (2.0, 0.0))
    assert edge(sonar, part(8.0, (8.0, 0.0))) == [[8.0, 0.0]]
    # The laser looks only to the right half: from half a turn on.
    assert edge(sonar, part(8.0, (-8.0, 0.0), first=0.5)) == [[2.0, 0.0], [-8.0, 0.0]]
