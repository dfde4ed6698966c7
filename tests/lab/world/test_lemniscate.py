import math

import numpy as np
import pytest

from skytether.lab.measures import kinematic_tracking_error
from skytether.lab.world.lemniscate import Lap, Lemniscate


def test_points_are_on_the_lemniscate_of_bernoulli_whose_foci_are_5_m_apart() -> None:
    curve = Lemniscate()
    x, y = curve.points.T
    assert (x**2 + y**2) ** 2 == pytest.approx(2 * 2.5**2 * (x**2 - y**2), abs=1e-9)
    # The product of the distances to the foci is the square of half of what is between them.
    product = np.hypot(x - 2.5, y) * np.hypot(x + 2.5, y)
    assert product == pytest.approx(2.5**2, abs=1e-9)
    # Length by the lemniscate constant: 2 * 2.62205755 times half of the width.
    assert curve.length == pytest.approx(2 * 2.62205755 * 2.5 * math.sqrt(2), abs=1e-4)


def test_headings_are_those_of_chords_all_round() -> None:
    curve = Lemniscate()
    assert curve.at(0.0) == pytest.approx((0, 0, -math.pi / 4), abs=1e-9)
    for s in np.linspace(0.01, curve.length - 0.01, 200):
        before, here, after = curve.at(s - 1e-3), curve.at(s), curve.at(s + 1e-3)
        chord = math.atan2(after.y - before.y, after.x - before.x)
        assert math.remainder(here.heading - chord, math.tau) == pytest.approx(0, abs=1e-3)
        assert math.dist(before[:2], after[:2]) == pytest.approx(2e-3, abs=1e-5)
    assert curve.at(curve.length + 1.0) == pytest.approx(curve.at(1.0))


def test_distances_and_tracking_error() -> None:
    curve = Lemniscate()
    # Beyond the right end the nearest point is the end; on the curve it is the point itself.
    distances = curve.distances([(curve.half_width + 0.3, 0.0), curve.at(4.0)[:2], (0.0, 0.0)])
    assert distances == pytest.approx([0.3, 0, 0], abs=2e-3)
    # Equation 5.1: the root of the mean's square and the variance is that of the mean square.
    assert kinematic_tracking_error(np.array([0.1, 0.3])) == pytest.approx(math.sqrt((0.01 + 0.09) / 2))


def test_a_lap_is_passed_in_order_and_not_cut_short_where_the_curve_crosses_itself() -> None:
    curve = Lemniscate()
    lap = Lap(curve)
    for s in np.arange(0.0, curve.length * 0.6, 0.05):
        assert lap.update(*curve.at(s)[:2]) == pytest.approx(s, abs=0.01)
    # Back to the crossing, where the round began and will end: nothing is skipped.
    assert lap.update(0.0, 0.0) < 0.62 * curve.length
    assert not lap.done
    for s in np.arange(curve.length * 0.6, curve.length, 0.05):
        lap.update(*curve.at(s)[:2])
    assert lap.done


def test_an_a_that_is_no_size_is_refused() -> None:
    for a in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(ValueError, match="a must be above 0 m"):
            Lemniscate(a)
