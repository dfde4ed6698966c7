"""What other robots see, as a layer above one's own: told, heard, bounded, gone after a while. Made-up time."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from deep_size import deep_size
from numpy.typing import NDArray

from skytether_services.navigation.costmap import FREE, LETHAL, UNKNOWN, Costmap, Costs
from skytether_services.navigation.footprint import Footprint
from skytether_services.navigation.neighbours import Neighbours, SharingParams
from skytether_services.navigation.obstacles import ObstacleParams, Scan
from skytether_services.navigation.shared_word import Said, Word, map_id, read_word, write_word
from skytether_services.planar.geometry import Pose

# 10 m by 10 m, with walls all around.
STATIC = Costmap(np.pad(np.full((98, 98), FREE, dtype=np.uint8), 1, constant_values=LETHAL), 0.1)
ROUND = Footprint(radius=0.3, padding=0.0)
ME, THERE = Pose(2.0, 2.0, 0.0), Pose(5.0, 5.0, 0.0)
RAYS = 720


def neighbours(**params: object) -> Neighbours:
    return Neighbours(SharingParams(**params), STATIC, ROUND, ObstacleParams())  # type: ignore[arg-type]


def scan(pose: Pose, at: tuple[float, float] | None = None, side: float = 0.3) -> Scan:
    """All around, of an empty hall, but for one disk."""
    angles = -math.pi + 2 * math.pi / RAYS * np.arange(RAYS)
    ranges = np.full(RAYS, 20.0, dtype=np.float32)
    if at is not None:
        away, towards = math.dist(pose[:2], at), math.atan2(at[1] - pose.y, at[0] - pose.x)
        hit = np.abs(np.angle(np.exp(1j * (angles + pose.yaw - towards)))) < math.asin(side / away)
        ranges[hit] = away - side
    return Scan(ranges, -math.pi, 2 * math.pi / RAYS, pose, 0.05, 20.0)


def marks(*cells: tuple[int, int]) -> Costs:
    layer = np.full_like(STATIC.costs, UNKNOWN)
    for cell in cells:
        layer[cell] = LETHAL
    return layer


def tells(pose: Pose = THERE, cells: list[list[int]] | None = None, age: float = 0.0) -> str:
    at = np.array(cells or [], dtype=np.intp).reshape(-1, 2)
    corners = np.array([[0.2, 0.2], [-0.2, 0.2], [-0.2, -0.2], [0.2, -0.2]])
    return write_word(map_id(STATIC), Word(pose, corners, at, np.full(len(at), age)))


def hear(me: Neighbours, now: float, said: list[Said]) -> None:
    me.receive(now, said)
    while me.read(now):
        pass


def lethal(layer: Costs | None) -> NDArray[np.intp]:
    return np.empty((0, 2), dtype=np.intp) if layer is None else np.argwhere(layer == LETHAL)


def has(layer: Costs | None, row: int, column: int) -> bool:
    return layer is not None and bool(layer[row, column] == LETHAL)


def test_without_a_group_nothing_is_told_and_nothing_counts() -> None:
    alone = neighbours()
    alone.observe(0.0, ME, scan(ME, (3.0, 2.0)))
    assert alone.word(0.1, ME, marks((20, 27))) is None
    assert alone.costs(0.1, ME) is None
    assert alone.names(0.1) == {}


def test_what_one_sees_the_other_plans_round() -> None:
    one, other = neighbours(), neighbours()
    hear(one, 0.0, [])
    one.observe(0.1, ME, scan(ME, (3.0, 2.0)))
    seen = [(row, column) for row in range(15, 26) for column in range(25, 36)]
    text = one.word(0.6, ME, marks(*seen))
    assert text is not None
    hear(other, 100.0, [Said("one", 0.5, text)])
    found = lethal(other.costs(100.0, Pose(8.0, 8.0, 0.0)))
    disk = found[found[:, 1] > 24]
    # The near side of the disk: its edge is 0.7 m ahead, at x = 2.7 m.
    assert len(disk) >= 3
    assert set(disk[:, 1].tolist()) <= {26, 27, 28}
    # And the robot itself, a circle of 0.3 m at (2, 2).
    body = found[found[:, 1] <= 24]
    assert body.min() >= 16
    assert body.max() <= 23
    assert len(body) >= 25
    assert other.names(100.0) == {"one": "heard"}


def test_walls_of_the_map_are_no_obstacles_and_neither_is_what_was_not_just_seen() -> None:
    one = neighbours(obstacles_last=60.0)
    hear(one, 0.0, [])
    near_wall = Pose(1.0, 5.0, math.pi)
    one.observe(0.1, near_wall, scan(near_wall, (0.0, 5.0), side=0.2))
    text = one.word(0.2, near_wall, marks((50, 1), (50, 2), (30, 30)))
    assert text is not None
    read = read_word(text, map_id(STATIC), STATIC.costs.shape)
    assert isinstance(read, Word)
    assert read.cells.tolist() == []


def test_what_others_see_lasts_for_its_time_and_where_they_are_for_less() -> None:
    me = neighbours(obstacles_last=60.0, robots_last=5.0)
    hear(me, 0.0, [Said("other", 1.0, tells(cells=[[50, 70]], age=20.0))])
    assert has(me.costs(0.0, ME), 50, 70)
    assert has(me.costs(3.9, ME), 50, 50)
    assert not has(me.costs(4.1, ME), 50, 50), "it said 5.1 s ago where it was"
    assert has(me.costs(38.9, ME), 50, 70)
    assert me.costs(39.1, ME) is None, "it was seen 60.1 s ago"
    hear(me, 39.2, [])
    assert me.names(39.2) == {}


def test_a_newer_word_takes_the_place_of_the_last_one() -> None:
    me = neighbours()
    hear(me, 0.0, [Said("other", 0.0, tells(cells=[[50, 70]]))])
    hear(me, 1.0, [Said("other", 0.0, tells(cells=[[50, 80]]))])
    assert not has(me.costs(1.0, ME), 50, 70)
    assert has(me.costs(1.0, ME), 50, 80)


def test_what_ones_own_laser_finds_free_is_free_until_another_sees_something_later() -> None:
    me = neighbours()
    hear(me, 0.0, [Said("other", 0.0, tells(cells=[[20, 40], [20, 70]]))])
    me.observe(0.5, ME, scan(ME))
    layer = me.costs(0.5, ME)
    assert not has(layer, 20, 40), "2 m ahead, and nothing is there"
    assert has(layer, 20, 70), "beyond the range in which rays clear"
    hear(me, 1.0, [Said("other", 0.0, tells(cells=[[20, 40]], age=0.8))])
    assert not has(me.costs(1.0, ME), 20, 40), "the same old word again"
    hear(me, 2.0, [Said("other", 0.0, tells(cells=[[20, 40]], age=0.2))])
    assert has(me.costs(2.0, ME), 20, 40)


def test_nothing_counts_where_the_robot_itself_stands_or_far_away() -> None:
    me = neighbours(reach=5.0)
    liar = [[row, column] for row in range(15, 26) for column in range(15, 26)]
    hear(me, 0.0, [Said("liar", 0.0, tells(Pose(2.1, 2.0, 0.0), cells=[*liar, [50, 50], [90, 90]]))])
    layer = me.costs(0.0, ME)
    for row, column in lethal(layer):
        assert 0.3 < math.hypot(row / 10 + 0.05 - 2.0, column / 10 + 0.05 - 2.0) <= 5.0
    assert has(layer, 50, 50)
    assert not has(layer, 90, 90)


def test_a_robot_is_not_told_of_itself() -> None:
    me = neighbours()
    hear(me, 0.0, [])
    for n in range(50):
        me.observe(0.1 * n, Pose(2.0 + 0.05 * n, 2.0, 0.0), scan(ME))
    # At 2.0 s it was at x = 3 m, and another one saw it there; at 5 s it is elsewhere. What is at x = 4.5 m is real.
    hear(me, 5.0, [Said("other", 1.0, tells(cells=[[20, 30], [20, 45]], age=2.0))])
    layer = me.costs(5.0, Pose(7.0, 7.0, 0.0))
    assert not has(layer, 20, 30)
    assert has(layer, 20, 45)


def test_a_robot_is_no_obstacle_to_be_told_of() -> None:
    me = neighbours()
    there = Pose(3.0, 2.0, 0.0)
    hear(me, 0.0, [Said("other", 0.0, tells(there))])
    me.observe(0.1, ME, scan(ME, (3.0, 2.0)))
    seen = marks(*[(row, column) for row in range(16, 25) for column in range(25, 35)])
    text = me.word(0.2, ME, seen)
    assert text is not None
    read = read_word(text, map_id(STATIC), STATIC.costs.shape)
    assert isinstance(read, Word)
    assert read.cells.tolist() == []
    # When it has said nothing for long, what is seen there is something.
    hear(me, 9.0, [])
    me.observe(9.1, ME, scan(ME, (3.0, 2.0)))
    text = me.word(9.2, ME, seen)
    assert text is not None
    read = read_word(text, map_id(STATIC), STATIC.costs.shape)
    assert isinstance(read, Word)
    assert len(read.cells) >= 3


def test_words_of_another_map_and_nonsense_count_for_nothing_and_are_named() -> None:
    me = neighbours()
    theirs = write_word("x", Word(THERE, np.eye(3)[:, :2], np.array([[50, 70]]), np.zeros(1)))
    hear(me, 0.0, [Said("a", 0.0, theirs), Said("b", 0.0, "nonsense")])
    assert me.costs(0.0, ME) is None
    assert me.names(0.0) == {"a": "another map", "b": "unreadable"}


def test_news_that_come_too_often_are_not_read() -> None:
    me = neighbours()
    hear(me, 0.0, [])
    hear(me, 0.1, [Said("other", 0.0, tells())])
    assert me.names(0.1) == {}
    hear(me, 0.5, [Said("other", 0.0, tells())])
    assert me.names(0.5) == {"other": "heard"}


def test_a_crowd_is_read_one_by_one_and_nobody_is_passed_over() -> None:
    me = neighbours()
    crowd = [Said(f"r{n}", 0.5, tells()) for n in range(10)]
    me.receive(0.0, crowd)
    for n in range(4):
        assert me.read(0.1 * n)
    me.receive(1.0, crowd)
    for _ in range(6):
        me.read(1.0)
    assert len(me.names(1.0)) == 10, "what came meanwhile did not begin anew"
    assert len(me.names(9.5)) == 10
    assert me.names(9.6) == {}, "it is as old as it is, however long it waited"


def test_no_more_robots_than_the_bound_are_kept_the_newest() -> None:
    me = neighbours()
    sizes = []
    for n in range(40):
        hear(me, float(n), [Said(f"r{n}", 0.0, tells())])
        sizes.append(deep_size(me))
    assert len(me.names(39.0)) == 11, "those of the last ten seconds"
    assert sizes[39] < 1.1 * sizes[15], "one that is forgotten takes no memory"


@pytest.mark.parametrize("which", ["tell", "listen"])
def test_each_way_can_be_switched_off(which: str) -> None:
    me = neighbours(**{which: False})
    hear(me, 0.0, [Said("other", 0.0, tells())])
    assert (me.word(0.1, ME, marks()) is None) == (which == "tell")
    assert (me.costs(0.1, ME) is None) == (which == "listen")


def test_an_outline_of_any_kind_is_told() -> None:
    square = replace(ROUND, corners=((0.3, 0.3), (-0.3, 0.3), (-0.3, -0.3), (0.3, -0.3)))
    me = Neighbours(SharingParams(), STATIC, square, ObstacleParams())
    hear(me, 0.0, [])
    text = me.word(0.1, ME, marks())
    assert text is not None
    read = read_word(text, map_id(STATIC), STATIC.costs.shape)
    assert isinstance(read, Word)
    assert read.outline == pytest.approx(np.array(square.corners))
