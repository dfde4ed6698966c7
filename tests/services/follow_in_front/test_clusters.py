"""Clusters of a scan and their features, against what was drawn."""

from __future__ import annotations

import numpy as np
from leg_scans import FIRST, LIMITS, STEP, scan

from skytether_services.follow_in_front.clusters import Clusters, clusters_of, rays_of
from skytether_services.follow_in_front.legs import both_legs, leg_like


def found(ranges: np.ndarray) -> Clusters:
    return clusters_of(rays_of(ranges, FIRST, STEP, *LIMITS))


def test_a_leg_is_a_round_cluster_as_wide_as_it_is() -> None:
    clusters = found(scan([(1.0, 0.2)]))
    assert len(clusters) == 1
    # The laser sees the near half: a chord a little shorter than the diameter, along an arc of half a circle.
    assert 0.085 < clusters.widths[0] < 0.11
    assert clusters.widths[0] < clusters.girths[0] < np.pi * 0.055
    assert abs(clusters.radii[0] - 0.055) < 0.003
    assert clusters.roundness[0] < 1e-3
    assert clusters.bulges[0] > 0.01
    # The middle of the half circle that is seen lies 2/pi of a radius before the leg's own, at the most.
    assert np.hypot(*(clusters.middles[0] - (1.0, 0.2))) < 0.055
    assert leg_like(clusters).all()
    assert not both_legs(clusters).any()


def test_a_leg_near_to_the_laser_is_one_though_its_many_points_are_noisy() -> None:
    random = np.random.default_rng(1)
    clusters = [found(scan([(0.45, 0.1)], random=random)) for _ in range(100)]
    assert all(leg_like(one).tolist() == [True] for one in clusters)
    # Half the way round it, and a little more for the noise.
    assert max(one.girths[0] for one in clusters) < 1.4 * np.pi * 0.055


def test_a_wall_is_straight_and_no_leg() -> None:
    clusters = found(scan([], [((2.0, -1.0), (2.0, 1.0))]))
    assert len(clusters) == 1
    assert abs(clusters.widths[0] - 2.0) < 0.05
    assert abs(clusters.bulges[0]) < 1e-5
    assert clusters.radii[0] > 10
    assert not leg_like(clusters).any()
    assert not both_legs(clusters).any()


def test_a_hollow_corner_is_no_leg() -> None:
    clusters = found(scan([], [((1.0, -0.09), (1.1, 0.0)), ((1.1, 0.0), (1.0, 0.09))]))
    assert len(clusters) == 1
    assert clusters.bulges[0] < -0.01
    assert not leg_like(clusters).any()


def test_the_end_that_something_nearer_cuts_off_is_hidden() -> None:
    clusters = found(scan([(1.0, 0.0)], [((2.0, -1.0), (2.0, 1.0))]))
    assert len(clusters) == 3
    # In the order of angles: wall to the right of the leg, leg, wall to its left.
    assert clusters.hidden.tolist() == [[False, True], [False, False], [True, False]]


def test_two_legs_that_touch_are_both_in_one_cluster() -> None:
    clusters = found(scan([(1.2, 0.08), (1.2, -0.08)], radius=0.08))
    assert len(clusters) == 1
    assert both_legs(clusters).all()
    assert not leg_like(clusters).any()


def test_rays_that_measured_nothing_are_passed_over() -> None:
    ranges = scan([(1.0, 0.0)])
    seen = np.flatnonzero(np.isfinite(ranges))
    ranges[seen[len(seen) // 2]] = np.nan
    assert len(found(ranges)) == 1
    for bad in (np.nan, np.inf, 0.0, -1.0, 60.0):
        assert len(found(np.full(772, bad, np.float32))) == 0
    assert len(found(np.zeros(0, np.float32))) == 0


def test_what_is_too_far_is_left_out() -> None:
    rays = rays_of(scan([(1.0, 0.0), (4.0, 1.0)]), FIRST, STEP, *LIMITS)
    assert len(clusters_of(rays)) == 2
    assert len(clusters_of(rays, furthest=3.0)) == 1
