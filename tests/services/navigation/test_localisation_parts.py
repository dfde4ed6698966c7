"""The pure parts of localisation, each by numbers that can be checked by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from skytether_services.navigation.bench_localisation import noisy_steps, scan_points
from skytether_services.navigation.global_search import distinct
from skytether_services.navigation.grid_map import GridMap
from skytether_services.navigation.likelihood_field import (
    EXPLAINED,
    OPEN,
    THROUGH,
    UNKNOWN,
    BeamModel,
    compare_beams,
    explain,
    likelihood_field,
)
from skytether_services.navigation.localisation import LocalisationParams, lead_credit, lead_needed
from skytether_services.navigation.motion_model import move_particles
from skytether_services.navigation.particles import (
    bin_keys,
    bulk,
    heaviest_cluster,
    kld_count,
    low_variance_sample,
    moments,
)
from skytether_services.navigation.poses import between, compose, wrap
from skytether_services.navigation.scan_odometry import usual_overlap


def test_a_step_is_what_lies_between_its_ends() -> None:
    start, step = np.array([1.0, 2.0, math.pi / 2]), np.array([2.0, 1.0, math.pi])
    # Facing up: two ahead are two up, one to the left is one back along x.
    np.testing.assert_allclose(compose(start, step), [0.0, 4.0, -math.pi / 2], atol=1e-12)
    np.testing.assert_allclose(np.abs(between(start, compose(start, step))), np.abs(step), atol=1e-12)
    np.testing.assert_allclose(wrap(np.array([3 * math.pi / 2, -7.0])), [-math.pi / 2, 2 * math.pi - 7.0])


def test_moved_particles_scatter_as_the_covariance_says() -> None:
    start = np.tile([1.0, 1.0, math.pi / 2], (4000, 1))
    covariance = np.diag([0.16, 0.01, 0.0025])
    moved = move_particles(start, np.array([2.0, 0.0, 0.0]), covariance, np.random.default_rng(1))
    # Facing up: along the step is along y.
    np.testing.assert_allclose(moved.mean(axis=0), [1.0, 3.0, math.pi / 2], atol=0.02)
    np.testing.assert_allclose(moved.std(axis=0), [0.1, 0.4, 0.05], rtol=0.05)


def test_low_variance_sampling_draws_each_as_often_as_it_weighs() -> None:
    # Marks at 0.125, 0.375, 0.625, 0.875 of the cumulated 0.1, 0.6, 0.6, 1.0.
    assert low_variance_sample(np.array([0.1, 0.5, 0.0, 0.4]), 4, 0.5).tolist() == [1, 1, 3, 3]


def test_particles_for_a_bound_on_the_kullback_leibler_distance() -> None:
    # Fox 2003: k = 50, error 0.05, 99 percent: 49 / 0.1 * (1 - 2/441 + sqrt(2/441) * 2.33)^3 = 749 or so.
    assert kld_count(1, 0.05, 2.33) == 1
    assert kld_count(50, 0.05, 2.33) == math.ceil(490 * (1 - 2 / 441 + math.sqrt(2 / 441) * 2.33) ** 3)
    assert 740 < kld_count(50, 0.05, 2.33) < 760


def test_bins_tell_places_and_headings_apart() -> None:
    particles = np.array([[0.1, 0.1, 0.0], [0.2, 0.2, 0.1], [0.3, 0.1, 0.0], [0.1, 0.1, 0.5], [-0.1, 0.1, 0.0]])
    keys = bin_keys(particles, 0.25, math.pi / 18)
    assert keys[0] == keys[1]
    assert len(set(keys.tolist())) == 4


def test_the_heaviest_place_counts_not_the_one_with_most_particles() -> None:
    many, few = np.tile([0.1, 0.1, 0.0], (30, 1)), np.array([[5.1, 5.1, 1.0], [5.2, 5.2, 1.1], [5.3, 5.1, 0.9]])
    weights = np.concatenate((np.full(30, 0.4 / 30), [0.2, 0.2, 0.2]))
    cluster = heaviest_cluster(np.concatenate((many, few)), weights, 0.6, math.radians(30))
    np.testing.assert_allclose(cluster.mean, [5.2, 15.4 / 3, 1.0], atol=1e-9)
    assert cluster.weight == pytest.approx(0.6)


def test_the_mean_of_headings_goes_through_the_back() -> None:
    particles = np.array([[0.0, 0.0, math.pi - 0.1], [2.0, 0.0, -math.pi + 0.1]])
    mean, covariance = moments(particles, np.array([0.5, 0.5]))
    np.testing.assert_allclose([mean[0], mean[1], abs(mean[2])], [1.0, 0.0, math.pi], atol=1e-12)
    # Each is 1 m and 0.1 rad off.
    np.testing.assert_allclose(np.diag(covariance), [1.0, 0.0, 0.01], atol=1e-12)


def test_a_likelihood_field_knows_distances_and_what_it_does_not_know() -> None:
    cells = np.zeros((3, 9), np.int8)
    cells[:, 0], cells[:, 8] = 100, -1
    field = likelihood_field(GridMap(cells, 0.1), BeamModel(sigma=0.1, outlier=0.05, unknown=0.3, max_distance=0.5))
    np.testing.assert_allclose(field.distance[1], [0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.5, 0.5, 0.5], atol=1e-6)
    # One standard deviation off: 0.05 + 0.95 exp(-1/2).
    expected = np.log([1.0, 0.05 + 0.95 * math.exp(-0.5), 0.3])
    np.testing.assert_allclose(field.log_likelihood[1, [0, 1, 8]], expected, atol=1e-5)
    assert field.known[1].tolist() == [1] * 8 + [0]
    assert len(field.free) == 21


def test_a_beam_is_explained_by_a_wall_that_was_seen_from_its_side() -> None:
    # Free from 0 to 2 m, a wall at 2 m, behind it nothing known up to 4 m; a second room of which only a wall is known.
    cells = np.full((3, 50), -1, np.int8)
    cells[:, :20], cells[:, 20], cells[:, 40] = 0, 100, 100
    field = likelihood_field(GridMap(cells, 0.1), BeamModel(explained=0.2))
    pose, starts = np.array([0.55, 0.15, 0.0]), np.zeros((4, 2))
    ends = np.array([[1.5, 0.0], [1.0, 0.0], [2.6, 0.0], [-1.5, 0.0]])
    assert compare_beams(field, pose, starts, ends).tolist() == [EXPLAINED, OPEN, THROUGH, UNKNOWN]
    # From behind, it is no more than thick somehow; what is known only as that says nothing.
    behind = np.array([3.0, 0.15, math.pi])
    assert compare_beams(field, behind, starts[:1], np.array([[0.9, 0.0]])).tolist() == [UNKNOWN]
    both = explain(field, pose, starts, ends)
    np.testing.assert_allclose([both.known, both.share, both.through], [0.75, 1 / 3, 1 / 3])
    # The one in the open and the unknown one tell nothing; of the two others, one speaks against the pose.
    np.testing.assert_allclose([both.telling, both.against], [0.5, 0.5])
    nothing = explain(field, pose, starts[:1], ends[1:2])
    assert (nothing.known, nothing.telling, nothing.against) == (1.0, 0.0, 0.0)


def test_near_hypotheses_are_one() -> None:
    poses = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.1], [0.1, 0.0, 2.0], [3.0, 0.0, 0.0], [6.0, 0.0, 0.0]])
    assert distinct(poses, 0.5, 0.5, 3) == [0, 2, 3]


def test_the_less_a_place_explains_the_more_it_has_to_lead() -> None:
    params = LocalisationParams(sure_share=0.7, sure_lead=0.25, least_share=0.4)
    needed = [lead_needed(share, params) for share in (0.39, 0.4, 0.6, 0.7, 1.0)]
    np.testing.assert_allclose(needed, [math.inf, 0.55, 0.35, 0.25, 0.25])


def test_a_small_lead_counts_in_part_and_less_than_half_of_it_not_at_all() -> None:
    params = LocalisationParams(sure_share=0.7, sure_lead=0.25, least_share=0.4)
    # A share of 0.9 needs 0.25, one of 0.5 needs 0.45.
    counted = [lead_credit(lead, 0.9, params) for lead in (0.5, 0.25, 0.2, 0.125, 0.12)]
    np.testing.assert_allclose(counted, [1.0, 1.0, 0.8, 0.5, 0.0])
    assert lead_credit(0.36, 0.5, params) == pytest.approx(0.8)
    assert lead_credit(math.inf, 0.39, params) == 0.0


def test_a_particle_far_out_is_not_in_the_bulk_of_them() -> None:
    # Deviations of 1 m, 1 m and 0.1 rad about (0, 0, pi), with weights that leave the last one out of the mean.
    corners = np.array([(x, y, math.pi + t) for x in (-1, 1) for y in (-1, 1) for t in (-0.1, 0.1)])
    particles = np.vstack((corners, [[3.0, 0.0, math.pi], [0.0, 0.0, -math.pi]]))
    particles[:, 2] = wrap(particles[:, 2])
    weights = np.array([0.125] * 8 + [0.0, 0.0])
    assert bulk(particles, weights, 2.5).tolist() == [True] * 8 + [False, True]


def test_what_scans_usually_continue_is_not_changed_by_a_single_bad_one() -> None:
    before = [0.8, 0.9, 0.1, 0.9, 0.9]
    assert usual_overlap(before) == 0.9
    assert usual_overlap(before[:4]) == 0.0


def test_noise_is_in_proportion_to_the_motion() -> None:
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 1.0]])
    steps = np.array([noisy_steps(poses, np.random.default_rng(seed)) for seed in range(500)])
    assert (steps[:, 0] == 0).all()
    assert (steps[:, 2] == 0).all()
    np.testing.assert_allclose(steps[:, 1, 0].std(), 0.1, atol=0.01)
    np.testing.assert_allclose(steps[:, 3, 2].std(), 0.1, atol=0.01)


def test_a_scans_points_are_those_that_met_something() -> None:
    angles = np.array([-math.pi / 2, 0.0, math.pi / 2])
    points = scan_points(np.array([1.0, 81.0, np.nan], np.float32), angles, 80.0)
    np.testing.assert_allclose(points, [[0.0, -1.0]], atol=1e-7)
