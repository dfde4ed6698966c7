"""What the floor that a robot saw says against a pose, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from skytether_services.navigation.grid_map import GridMap
from skytether_services.navigation.likelihood_field import LikelihoodField, likelihood_field
from skytether_services.navigation.seen_floor import Floor, seen_floor

HERE = np.array([[0.0, 0.0]])


def hall() -> LikelihoodField:
    """10 by 4 m: a wall of one cell at 5 m, floor before it, and nothing known from 8 m on."""
    cells = np.zeros((40, 100), np.int8)
    cells[:, 50] = 100
    cells[:, 80:] = -1
    return likelihood_field(GridMap(cells, 0.1, (0.0, 0.0, 0.0)))


def test_floor_is_what_beams_crossed_but_not_near_what_they_ended_at() -> None:
    ends = np.array([[3.0, y] for y in np.linspace(-0.5, 0.5, 21)])
    floor = seen_floor(np.zeros(ends.shape), ends)
    assert floor[:, 0].max() == pytest.approx(2.7, abs=0.1)
    assert np.abs(floor[:, 1]).max() < 0.6
    # All of the middle beam, cell by cell.
    assert len(np.unique(np.round(floor[np.abs(floor[:, 1]) < 0.1][:, 0], 2))) >= 26


def test_what_one_beam_ended_at_and_many_crossed_is_floor() -> None:
    ends = np.array([[3.0, 0.0]] * 10 + [[1.5, 0.0]])
    floor = seen_floor(np.zeros(ends.shape), ends)
    assert np.abs(floor - (1.5, 0.0)).max(axis=1).min() < 0.11
    assert len(seen_floor(np.zeros((0, 2)), np.zeros((0, 2)))) == 0


def test_walls_speak_more_against_a_pose_than_what_is_not_known() -> None:
    field = hall()
    floor = Floor(np.array([[x + 0.05, 0.05] for x in np.arange(0, 2, 0.1)]), HERE)
    fits, wall, unknown, off = (floor.against(field, np.array([x, 2.0, 0.0])) for x in (1.0, 4.0, 7.0, 20.0))
    assert fits == 0.0
    assert wall == pytest.approx(12.0 / 20)
    assert unknown == pytest.approx(0.4 / 2)
    # Off the map the robot itself is where nothing is known, too.
    assert off == pytest.approx(0.8)
    # Turned about, the same floor lies elsewhere.
    assert floor.against(field, np.array([6.0, 2.05, np.pi])) > 0


def test_nothing_seen_says_nothing() -> None:
    assert Floor(np.zeros((0, 2)), np.zeros((0, 2))).against(hall(), np.array([5.05, 2.0, 0.0])) == 0.0
