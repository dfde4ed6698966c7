"""The figures of ``skytether lab bench navigation --delays`` and ``--cluttered``, by hand."""

from typing import Any

import numpy as np
import pytest

from skytether.control.admittance import Velocity
from skytether_services.navigation.bench_courses import (
    Course,
    Predictions,
    compared,
    delay_verdict,
    distance_from,
    score,
    summed_up,
)
from skytether_services.navigation.prediction import State
from skytether_services.planar.geometry import Pose


def test_distance_from_a_path() -> None:
    path = np.array([(0.0, 0.0), (2.0, 0.0), (2.0, 0.0), (2.0, 2.0)])
    assert distance_from(path, (1.0, 0.3)) == pytest.approx(0.3)
    assert distance_from(path, (2.5, 1.0)) == pytest.approx(0.5)
    assert distance_from(path, (-3.0, -4.0)) == pytest.approx(5.0)


def test_a_prediction_is_held_against_the_motion_and_not_the_place() -> None:
    """It drives 0.02 m north in each tick of 10 ms. It is believed to be elsewhere, and to face east."""
    predictions = Predictions(5.0)
    for tick in range(1, 8):
        predictions.saw(Pose(1.0, 0.02 * tick, np.pi / 2))
    still = Velocity(0.0, 0.0)
    # Seen at the end of tick 2; the command arrives in tick 6, so it acts from the end of tick 5 on.
    predictions.sent(5.04, State(Pose(9.0, 9.0, 0.0), still, 5.02), State(Pose(9.05, 9.0, 0.0), still, 5.06))
    predictions.arrived(5.04, 5.06)
    assert predictions.errors == [pytest.approx(0.06 - 0.05)]
    predictions.arrived(5.03, 5.06)  # it was sent while the robot stood
    assert len(predictions.errors) == 1


def test_a_command_that_is_late_is_an_error_along_the_way_and_a_wrong_turn_one_across_it() -> None:
    predictions = Predictions(0.0)
    # Each tick 0.01 m along a heading that it turned to in the first one.
    for tick in range(1, 9):
        predictions.saw(Pose(0.01 * tick * np.cos(0.5), 0.01 * tick * np.sin(0.5), 0.5 if tick > 1 else 0.0))
    still = Velocity(0.0, 0.0)
    seen, far = State(Pose(0.0, 0.0, 0.0), still, 0.01), 0.05
    for tick, place in ((3, (far * np.cos(0.5), far * np.sin(0.5))), (4, (far, 0.0))):
        expected = State(Pose(float(place[0]), float(place[1]), 0.5), still, 0.07)
        predictions.sent(tick / 100, seen, expected)
        predictions.arrived(tick / 100, 0.08)
    # It truly went 0.06 m.
    np.testing.assert_allclose(predictions.across, [0.0, 0.05 * np.sin(0.5)], atol=1e-12)
    np.testing.assert_allclose(predictions.errors[0], 0.01, atol=1e-12)


def test_score_counts_time_between_two_and_eight_optimal_ones() -> None:
    assert score(True, 10.0, 12.0) == pytest.approx(1 / 2)
    assert score(True, 10.0, 40.0) == pytest.approx(1 / 4)
    assert score(True, 10.0, 900.0) == pytest.approx(1 / 8)
    assert score(False, 10.0, 12.0) == 0.0


def rows(off: float, fixed: float, measured: float, late: float, state: str = "succeeded") -> list[dict[str, Any]]:
    def row(trip: float, jitter: float, kind: str, error: float, seconds: float) -> dict[str, Any]:
        told = {"round_trip": trip, "jitter": jitter, "told": trip, "compensation": kind}
        return {
            **told,
            "path_error": error,
            "prediction_error": error,
            "prediction_across": error / 9,
            "seconds": seconds,
            "state": state,
        }

    plain = [row(0.0, 0.0, "measured", 0.02, 100.0), row(0.2, 0.0, "measured", 0.02, late)]
    errors = {"off": off, "fixed": fixed, "measured": measured}
    return plain + [row(0.2, 0.04, kind, error, late) for kind, error in errors.items()]


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ((0.1, 0.06, 0.05, 105.0), (True, True, True)),
        ((0.1, 0.04, 0.05, 106.0), (False, False, True)),
        ((0.1, 0.07, 0.06, 104.0), (True, True, False)),
        ((0.1, 0.06, 0.05, 105.0, "failed"), (False, False, False)),
    ],
)
def test_verdict_of_the_delays(given: Any, expected: tuple[bool, bool, bool]) -> None:
    found = delay_verdict(rows(*given))
    assert (found["time_within_bar"], found["measured_beats_fixed"], found["measured_halves_off"]) == expected


def test_drives_over_one_link_are_summed_up_and_a_failed_one_is_told() -> None:
    courses = [Course("succeeded", 40.0, 0.02, 0.01, 0.001, 0), Course("failed", 44.0, 0.04, 0.03, 0.001, 1)]
    found = summed_up(courses)
    assert (found["state"], found["contacts"], found["seconds"]) == ("failed", 1, 42.0)
    assert found["path_error"] == pytest.approx(0.03)
    assert found["path_error_std"] == pytest.approx(0.02 / np.sqrt(2))
    assert summed_up(courses[:1])["path_error_std"] is None


def test_fixed_is_compared_with_measured_over_the_link_that_it_was_told_another_delay_of() -> None:
    def row(kind: str, told: float, errors: list[float]) -> dict[str, Any]:
        courses = [Course("succeeded", 40.0, error, 0.01, 0.001, 0) for error in errors]
        return {"round_trip": 0.35, "jitter": 0.0, "told": told, "compensation": kind, **summed_up(courses)}

    rows = [row("fixed", 0.2, [3.0, 4.0, 5.0]), row("measured", 0.2, [1.0, 2.0, 3.0])]
    (found,) = compared(rows)  # the predictions do not differ at all
    assert (found["told"], found["error"]) == (0.2, "path_error")
    # Two units apart, both with variance 1: t = 2 / sqrt(2/3).
    assert found["t"] == pytest.approx(2.45)
    assert found["p"] == pytest.approx(0.07, abs=0.01)
