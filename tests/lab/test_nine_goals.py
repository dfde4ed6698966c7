"""The navigation experiment: its numbers, and one short drive with all that is real."""

import math
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from skytether.cli.app import app
from skytether.lab.nine_goals import SCENARIOS, Scenario, Trial, TrialResult, TrialSettings
from skytether.lab.nine_goals_report import compare_times, summary

RESULT = TrialResult(
    scenario="edge", seed=1, completed=True, contacts=0, goals=9, start_s=1.0, time_s=100.0, distance_m=41.0,
    first_leg_m=4.0, mean_speed_m_s=0.41, rtt_ms=28.0, robot_cpu=0.1, service_cpu=0.2, service_memory_mb=300.0,
    message="The last goal was reached.", topics=(),
)  # fmt: skip


def test_a_scenario_is_halved_between_both_ways() -> None:
    up, down = (Scenario("x", rtt_s=0.2, jitter_s=0.02, loss=0.02).link(3, direction) for direction in (0, 1))
    assert up.delay + down.delay == pytest.approx(0.2)
    assert math.hypot(up.jitter, down.jitter) == pytest.approx(0.02)
    assert (1 - up.loss) * (1 - down.loss) == pytest.approx(0.98)
    assert up.seed != down.seed


def test_trials_are_summed_up_by_scenario_over_those_that_were_completed() -> None:
    slow = replace(RESULT, seed=2, time_s=110.0, start_s=math.nan)
    hit = replace(RESULT, seed=3, completed=False, contacts=2, time_s=500.0)
    far = replace(RESULT, scenario="private", time_s=120.0)
    edge, private = summary([RESULT, slow, hit, far])
    assert (edge["scenario"], edge["trials"], edge["completed"], edge["contacts"]) == ("edge", 3, 2, 2)
    assert (edge["time_s"], edge["time_s_std"]) == (105.0, 7.071)
    assert (edge["start_s"], edge["start_s_std"]) == (1.0, None)
    assert (private["time_s"], private["time_s_std"]) == (120.0, None)


def test_completion_times_are_compared_as_in_the_thesis() -> None:
    base = [replace(RESULT, scenario="0 ms", time_s=time) for time in (100.0, 101.0, 102.0)]
    late = [replace(RESULT, scenario="200 ms", time_s=time) for time in (101.0, 102.0, 103.0)]
    (row,) = compare_times([*base, *late], "0 ms")
    # Two samples of three with variance 1: t = 1 / sqrt(2 / 3).
    assert row["t"] == pytest.approx(1.225, abs=1e-3)
    assert row["p"] == pytest.approx(0.2879, abs=1e-4)
    assert row["slower"] == pytest.approx(1 / 101, abs=1e-4)
    assert compare_times([*base, late[0]], "0 ms") == []


def test_an_unknown_scenario_is_refused() -> None:
    done = CliRunner().invoke(app, ["lab", "run", "navigation", "--scenario", "moon"])
    assert done.exit_code == 2
    assert "there is no scenario 'moon'; there are embedded, edge, commercial, private" in done.output


@pytest.mark.slow
def test_a_robot_is_driven_to_the_first_goal_by_a_service_of_its_own() -> None:
    with Trial(TrialSettings(SCENARIOS["commercial"], goals=1)) as trial:
        result = trial.drive()
    assert result.completed, result
    assert (result.goals, result.contacts) == (1, 0)
    goal, robot = trial.plan.goals[0], trial.world.robots[0]
    assert math.dist((goal.x, goal.y), robot.pose[:2]) < 0.4
    assert result.rtt_ms > 100
    assert result.service_cpu > 0
    assert result.service_memory_mb > 50
    rows = {row.topic: row for row in result.topics}
    assert {"tf", "odom", "scan", "cmd_vel", "status", "map"} <= rows.keys()
    assert result.document()["topics"][0]["topic"] in rows
