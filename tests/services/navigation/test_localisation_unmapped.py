"""Localisation where most of what the laser sees is on no map. Its functions compile for a while."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from skytether_services.navigation.grid_map import GridMap
from skytether_services.navigation.likelihood_field import explain, likelihood_field
from skytether_services.navigation.localisation import Estimate, Localisation
from skytether_services.navigation.poses import between, compose

pytestmark = pytest.mark.slow

Array = NDArray[np.float64]

LENGTH, WIDTH = 12.0, 6.0
ANGLES = np.radians(np.arange(-135.0, 135.1, 1.5))
STEP = np.array([0.1, 0.0, 0.0])


def hall() -> GridMap:
    """Walls of 0.1 m around a free floor that begins at the origin; nothing else is on the map."""
    cells = np.zeros((round(WIDTH / 0.05) + 4, round(LENGTH / 0.05) + 4), np.int8)
    cells[:2] = cells[-2:] = cells[:, :2] = cells[:, -2:] = 100
    return GridMap(cells, 0.05, (-0.1, -0.1, 0.0))


def poles() -> Array:
    """n by x, y, radius [m]: on both sides of a lane along the middle."""
    ys = (0.9, 1.7, 2.3, 3.7, 4.3, 5.1)
    return np.array([(1.5 + 0.6 * i + 0.2 * (j % 3), y, 0.13) for i in range(16) for j, y in enumerate(ys)])


def seen_from(pose: Array, standing: Array) -> Array:
    """Ends of the beams in the robot's frame, n by 2, with noise of 1 cm."""
    directions = np.column_stack((np.cos(ANGLES + pose[2]), np.sin(ANGLES + pose[2])))
    with np.errstate(divide="ignore"):
        to_walls = np.where(directions > 0, np.array([LENGTH, WIDTH]) - pose[:2], -pose[:2]) / directions
    ranges = np.where(np.isfinite(to_walls), to_walls, np.inf).min(axis=1)
    for x, y, radius in standing:
        to_pole = np.array([x, y]) - pose[:2]
        along = directions @ to_pole
        square = radius**2 - (to_pole @ to_pole - along**2)
        hit = (square > 0) & (along > 0)
        ranges = np.where(hit, np.minimum(ranges, along - np.sqrt(np.maximum(square, 0.0))), ranges)
    ranges = ranges + np.random.default_rng(round(1000 * float(pose[0]))).normal(0.0, 0.01, len(ranges))
    return np.column_stack((ranges * np.cos(ANGLES), ranges * np.sin(ANGLES)))


def driven(believed: Array, truth: Array, standing: Array, steps: int) -> tuple[list[Estimate], Array]:
    """Estimates on the way straight on, and where the robot really is in the end; its wheels tell 5 % too much."""
    localisation = Localisation(likelihood_field(hall()), np.random.default_rng(1))
    localisation.place(believed, np.diag([0.01, 0.01, 0.001]))
    estimates = []
    for _ in range(steps):
        truth = compose(truth, STEP)
        estimates.append(localisation.update(1.05 * STEP, seen_from(truth, standing)))
    return estimates, truth


def test_it_is_tracked_through_a_field_of_which_the_map_shows_nothing() -> None:
    start = np.array([0.8, 3.0, 0.0])
    estimates, truth = driven(start, start, poles(), 90)
    field = likelihood_field(hall())
    middle = seen_from(np.array([6.0, 3.0, 0.0]), poles())
    seen = explain(field, np.array([6.0, 3.0, 0.0]), np.zeros(middle.shape), middle)
    assert seen.share < 0.45, "most beams end at what is on no map"
    assert seen.against < 0.1
    assert all(estimate.sure for estimate in estimates)
    off = between(truth, estimates[-1].pose)
    assert math.hypot(off[0], off[1]) < 0.1
    assert abs(off[2]) < 0.03


def test_a_pose_from_which_beams_pass_walls_is_doubted_in_such_a_field_too() -> None:
    # It believes that it drives towards the near wall, and sees along the hall.
    estimates, _ = driven(np.array([2.0, 3.0, math.pi / 2]), np.array([0.8, 3.0, 0.0]), poles(), 12)
    assert not estimates[-1].sure


def test_a_robot_that_was_carried_away_notices_it_and_one_whose_view_was_blocked_goes_on() -> None:
    standing = poles()[::5]
    start, elsewhere = np.array([0.8, 3.0, 0.0]), np.array([6.0, 1.5, 2.0])
    localisation = Localisation(likelihood_field(hall()), np.random.default_rng(1))
    localisation.place(start, np.diag([0.01, 0.01, 0.001]))
    truth = start
    for _ in range(20):
        truth = compose(truth, STEP)
        localisation.update(STEP, seen_from(truth, standing))
    stand = np.zeros(3)
    assert localisation.update(stand, seen_from(truth, standing)).sure
    # A wall of people at 0.5 m before it: nothing of what was seen before is left. Then they go away.
    crowd = 0.5 * np.column_stack((np.cos(ANGLES), np.sin(ANGLES)))
    assert not localisation.update(stand, crowd).sure
    assert localisation.update(stand, seen_from(truth, standing)).sure
    # Carried away with standing wheels, it is not sure, and stays so while it stands.
    assert not localisation.update(stand, seen_from(elsewhere, standing)).sure
    assert not localisation.update(stand, seen_from(elsewhere, standing)).sure
