"""The figures of ``skytether lab bench navigation --delays`` and ``--cluttered``, by hand."""

from typing import Any

import numpy as np
import pytest

from skytether.control.admittance import Velocity
from skytether.lab.world.plan import Plan, building
from skytether_services.navigation import bench_courses
from skytether_services.navigation.bench_courses import (
    Course,
    Predictions,
    compared,
    delay_verdict,
    distance_from,
    measure_delays,
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


def test_the_time_is_judged_only_with_the_links_that_it_needs() -> None:
    every = rows(0.1, 0.06, 0.05, 105.0)
    some = [row for row in every if row["jitter"] or not row["round_trip"]]
    found = delay_verdict(some)
    assert found == {"measured_beats_fixed": True, "measured_halves_off": True}
    assert delay_verdict(every) == {"time_within_bar": True, **found}


def test_with_jitter_only_two_links_are_driven_through_the_plan_that_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = []

    def to_goals(plan: Plan, goals: int, params: Any, seed: int, link: Any) -> Course:
        driven.append((plan.name, plan.people, goals, params["delay"]["compensation"], link.delay, link.loss, seed))
        return Course("succeeded", 40.0, 0.01, 0.01, 0.001, 0)

    monkeypatch.setattr(bench_courses, "_to_goals", to_goals)
    monkeypatch.setattr(bench_courses, "compared", lambda _: [])  # SciPy takes long to load
    found = measure_delays(plan=building(), goals=4, runs=2, seed=7, jitter_only=True, progress=lambda _: None)
    links = [("measured", 0.0, 0.0), *((kind, 0.1, 0.02) for kind in ("off", "fixed", "measured"))]
    assert driven == [("building", (), 4, *link, seed) for link in links for seed in (7, 8)]
    assert "time_within_bar" not in found
    assert found["plan"] == "building"
    found = measure_delays(plan=building(), goals=4, runs=1, seed=7, jitter_only=False, progress=lambda _: None)
    assert len(found["rows"]) == 6 * 3 + 2 * 2  # where the fixed one is told something else, none is without
    assert found["time_within_bar"]


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

    rows = [row("fixed", 0.2, [3.0, 4.0, 5.0]), row("measured", 0.2, [2.0, 2.0, 2.0])]
    (found,) = compared(rows)  # the predictions do not differ at all
    assert (found["told"], found["error"]) == (0.2, "path_error")
    # In pairs 1, 2 and 3 apart, with variance 1: t = 2 / sqrt(1/3) of two degrees of freedom, whose 95 % are at 4.303.
    assert (found["test"], found["difference"]) == ("paired", 2.0)
    assert found["t"] == pytest.approx(3.46)
    assert found["p"] == pytest.approx(0.074, abs=0.001)
    assert (found["low"], found["high"]) == pytest.approx((2 - 4.303 / 3**0.5, 2 + 4.303 / 3**0.5), abs=0.001)
