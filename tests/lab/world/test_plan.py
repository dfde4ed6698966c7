import itertools
import math
from pathlib import Path

import numpy as np
import pytest

from skytether.lab.world.occupancy import Occupancy
from skytether.lab.world.people import CLEARANCE, Person
from skytether.lab.world.plan import Box, PlanError, Walk, building, parse_plan, read_plan
from skytether.lab.world.robot import RobotParams

MINIMAL = "starts: [[0, 0, 0]]\ngoals: [[1, 0, 90]]\n"


def test_the_building_has_nine_goals_on_a_closed_way_of_41_m() -> None:
    plan = building()
    assert len(plan.goals) == 9
    assert math.dist(plan.goals[-1][:2], plan.starts[0][:2]) < 0.1
    assert plan.way_length() == pytest.approx(41, abs=0.5)
    # Figure 36 and Table 6 of the thesis: 3.8 m from goal 1 to goal 2, where the person steps in.
    assert math.dist(plan.goals[0][:2], plan.goals[1][:2]) == pytest.approx(3.8, abs=0.1)


def test_the_straight_lines_between_the_goals_are_free_for_the_robot() -> None:
    plan = building()
    points = np.array([(p.x, p.y) for p in (plan.starts[0], *plan.goals)])
    line = np.concatenate([np.linspace(a, b, 200) for a, b in itertools.pairwise(points)])
    assert plan.clearance(line).min() > RobotParams().width / 2 + 0.1


def test_starts_and_goals_have_room_to_turn() -> None:
    plan = building()
    points = np.array([(p.x, p.y) for p in (*plan.starts, *plan.goals)])
    assert plan.clearance(points).min() > RobotParams().circumscribed


def test_people_walk_through_nothing() -> None:
    plan = building()
    for walk in (*plan.people, *plan.rounds):
        line = np.concatenate([np.linspace(a, b, 200) for a, b in zip(walk.way, walk.way[1:], strict=False)])
        assert plan.clearance(line).min() > 0.25, walk.name


def test_distance_to_a_turned_box() -> None:
    box = Box("box", 1.0, 0.0, 2.0, 1.0, math.pi / 2)  # 1 wide in x, 2 in y
    points = np.array([(1.0, 0.0), (2.0, 0.0), (1.0, 2.0), (1.8, 1.4)])
    assert box.distance(points) == pytest.approx([0.0, 0.5, 1.0, 0.5])
    assert sorted(map(tuple, box.corners().round(9).tolist())) == [(0.5, -1), (0.5, 1), (1.5, -1), (1.5, 1)]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[1", "not valid YAML"),
        ("- 1", "must be a mapping"),
        ("starts: []\ngoals: []", "at least one start"),
        ("starts: [[0, 0, 0]]", "goals is missing"),
        (MINIMAL + "doors: []", "doors is not known"),
        (MINIMAL + "walls: [[0, 0, 1]]", r"walls\[0\]: it must be 4 numbers"),
        (MINIMAL + "walls: [[0, 0, 0, 0]]", r"walls\[0\]: it has no length"),
        (MINIMAL + "boxes: [{at: [0, .nan], size: [1, 1]}]", r"boxes\[0\].at: it must be 2 numbers"),
        (MINIMAL + "cylinders: [{at: [0, 0], radius: 0}]", r"cylinders\[0\].radius"),
        (MINIMAL + "boxes: [{name: a, at: [0, 0], size: [1, 1]}, {name: a, at: [0, 0], size: [1, 1]}]", "name a"),
        (MINIMAL + "people: [{name: a, way: [[0, 0]], speed: 1}]", r"people\[0\]: it needs a way"),
    ],
)
def test_a_broken_plan_is_named(text: str, sentence: str) -> None:
    with pytest.raises(PlanError, match=sentence):
        parse_plan(text)


def test_a_plan_of_ones_own_and_where_it_is_broken(tmp_path) -> None:
    file = tmp_path / "hall.yaml"
    file.write_text(MINIMAL + "name: hall\n")
    assert read_plan(file).name == "hall"
    file.write_text("name: hall\n")
    with pytest.raises(PlanError, match=r"hall\.yaml: the plan: goals is missing"):
        read_plan(file)


def test_the_aisle_of_the_examples_leaves_1_4_m_beside_each_shelf() -> None:
    plan = read_plan(Path(__file__).parents[3] / "docs" / "examples" / "aisle.yaml")
    shelves = [box for box in plan.boxes if box.name.startswith("shelf")]
    assert [box.x for box in shelves] == pytest.approx([1.8, 3.6, 5.4, 7.2, 9.0, 10.8])
    sides = [-1, 1, -1, 1, -1, 1]
    middles = np.array([(box.x, -side * 0.9) for box, side in zip(shelves, sides, strict=True)])
    assert plan.clearance(middles) == pytest.approx(np.full(6, 0.7))
    assert plan.bounds() == pytest.approx((-0.1, -1.7, 12.7, 1.7))
    # The map of the drives that docs/navigation.md tells of; one that begins elsewhere makes others of them.
    drawn = Occupancy(plan)
    assert (drawn.grey.shape, drawn.origin) == ((88, 276), pytest.approx((-0.6, -2.2)))
    assert (plan.starts[0], plan.goals) == ((0.7, 0.0, 0.0), ((11.9, 0.0, 0.0),))


def test_a_person_waits_to_be_triggered_walks_pauses_and_is_done() -> None:
    person = Person(Walk("p", ((0, 0), (1, 0), (0, 0)), speed=1.0, pause=2.0, after=(5.0, 0.0, 0.5)))
    for _ in range(100):
        person.step([(9.0, 0.0)], 0.01)
    assert not person.begun
    stances = [person.step([(5.3, 0.0)], 0.01) for _ in range(150)]
    assert person.pose.x == pytest.approx(1.0)
    # Feet apart in the stride, together at rest.
    assert max(abs(s.left[0] - s.right[0]) for s in stances) > 0.2
    for _ in range(500):
        stance = person.step([(5.3, 0.0)], 0.01)
    assert person.done
    assert stance.trunk == pytest.approx((0, 0))


def test_a_person_does_not_walk_into_a_robot_but_may_walk_away_from_it() -> None:
    person = Person(Walk("p", ((0, 0), (3, 0)), speed=1.0))
    for _ in range(500):
        person.step([(2.0, 0.0)], 0.01)
    assert 2.0 - person.pose.x == pytest.approx(CLEARANCE, abs=0.02)
    person = Person(Walk("p", ((0, 0), (3, 0)), speed=1.0))
    for _ in range(500):
        person.step([(-0.3, 0.0)], 0.01)
    assert person.done
