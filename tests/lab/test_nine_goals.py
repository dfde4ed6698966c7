"""The navigation experiment: its numbers, and one short drive with all that is real."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image
from typer.testing import CliRunner

from skytether.cli.app import app
from skytether.lab.nine_goals import SCENARIOS, NineGoalsSettings, NineGoalsTrial
from skytether.lab.nine_goals_figures import draw_figures
from skytether.lab.nine_goals_report import compare_times, summary, topics
from skytether.lab.nine_goals_result import NineGoalsResult, NineGoalsTraces
from skytether.lab.trial.results import KeptTrials, TopicRow
from skytether.lab.world.plan import building

RESULT = NineGoalsResult(
    scenario="edge", seed=1, completed=True, contacts=0, goals=9, start_s=1.0, time_s=100.0, distance_m=41.0,
    first_leg_m=4.0, mean_speed_m_s=0.41, rtt_ms=28.0, robot_cpu=0.1, service_cpu=0.2, service_memory_mb=300.0,
    message="The last goal was reached.", topics=(),
)  # fmt: skip


def test_trials_are_summed_up_by_scenario_over_those_that_were_completed() -> None:
    slow = replace(RESULT, seed=2, time_s=110.0, start_s=math.nan)
    hit = replace(RESULT, seed=3, completed=False, contacts=2, time_s=500.0)
    far = replace(RESULT, scenario="private", time_s=120.0)
    edge, private = summary([RESULT, slow, hit, far])
    assert (edge["scenario"], edge["trials"], edge["completed"], edge["contacts"]) == ("edge", 3, 2, 2)
    assert (edge["time_s"], edge["time_s_std"]) == (105.0, 7.071)
    assert (edge["start_s"], edge["start_s_std"]) == (1.0, None)
    assert (private["time_s"], private["time_s_std"]) == (120.0, None)


@pytest.mark.slow  # imports SciPy's statistics
def test_completion_times_are_compared_as_in_the_thesis() -> None:
    base = [replace(RESULT, scenario="0 ms", time_s=time) for time in (100.0, 101.0, 102.0)]
    late = [replace(RESULT, scenario="200 ms", time_s=time) for time in (101.0, 102.0, 103.0)]
    (row,) = compare_times([*base, *late], "0 ms")
    # Two samples of three with variance 1: t = 1 / sqrt(2 / 3).
    assert row["t"] == pytest.approx(1.225, abs=1e-3)
    assert row["p"] == pytest.approx(0.2879, abs=1e-4)
    assert row["slower"] == pytest.approx(1 / 101, abs=1e-4)
    assert compare_times([*base, late[0]], "0 ms") == []


@pytest.mark.slow  # likewise
def test_the_thesis_has_a_test_of_its_own_beside_ours() -> None:
    near = [replace(RESULT, scenario="edge", time_s=time) for time in (100.0, 101.0)]
    far = [replace(RESULT, scenario="embedded", time_s=time) for time in (120.0, 121.0)]
    (row,) = compare_times([*near, *far], "edge")
    # 128.7 with 13.1 against 100.6 with 3.6, five of each: t = 28.1 / sqrt((13.1^2 + 3.6^2) / 5).
    assert row["thesis_t"] == pytest.approx(28.1 / math.sqrt((13.1**2 + 3.6**2) / 5), abs=1e-3)
    assert row["thesis_p"] < 0.05


def test_topics_are_summed_up_over_completed_trials_beside_the_period_that_they_are_sent_with() -> None:
    trials = [
        replace(RESULT, seed=seed, topics=(TopicRow("scan", 900, lost, 20.0, 5.0, period, 180.0),))
        for seed, lost, period in ((1, 0.01, 119.0), (2, 0.03, 121.0))
    ]
    hit = replace(trials[0], completed=False, topics=(TopicRow("scan", 900, 0.5, 20.0, 5.0, 500.0, 900.0),))
    (row,) = topics([*trials, hit])
    assert (row["topic"], row["ideal_ms"], row["period_ms"], row["lost"]) == ("scan", 120.0, 120.0, 0.02)
    assert row["period_ms_std"] == pytest.approx(math.sqrt(2), abs=1e-4)
    (slow,) = topics([replace(RESULT, scenario="embedded", topics=(TopicRow("cmd_vel", 1, 0.0, 1.0, 1.0, 167.0),))])
    assert slow["ideal_ms"] == pytest.approx(166.7, abs=0.1)
    assert slow["period_p99_ms"] is None


TRACES = NineGoalsTraces(
    way=((1.0, 1.0), (5.0, 1.0), (7.0, 1.4), (8.8, 1.2)), goals=(1, 3), person=((7.3, 3.4), (7.3, 1.1)),
    plans=(((5.0, 1.0), (8.8, 1.2)),), sent_kbit_s=(700.0, 720.0), arrived_kbit_s=(690.0, 710.0),
)  # fmt: skip
ROWS = tuple(TopicRow(topic, 900, 0.01, 20.0, 5.0, 100.0, 180.0) for topic in ("tf", "odom", "scan", "cmd_vel"))


# As `lab run navigation --keep` has written it since it was there.
KEPT = """\
{"asked":{"scenario":"edge","seed":1,"goals":9,"rtt_s":0.0287,"jitter_s":0.0209,"loss":0.005,"cpu":null,\
"params":{},"image":""},"result":{"scenario":"edge","seed":1,"completed":true,"contacts":0,"goals":9,\
"start_s":1.0,"time_s":100.0,"distance_m":41.0,"first_leg_m":4.0,"mean_speed_m_s":0.41,"rtt_ms":null,\
"robot_cpu":0.1,"service_cpu":0.2,"service_memory_mb":300.0,"message":"The last goal was reached.",\
"topics":[{"topic":"scan","sent":900,"lost":0.01,"delay_ms":20.0,"jitter_ms":5.0,"period_ms":119.0,\
"period_p99_ms":180.0}],"robot_memory_mb":null,"on_robot":false,"traces":{"way":[[1.0,1.0],[5.0,1.0]],\
"goals":[1],"person":[[7.3,3.4]],"plans":[[[5.0,1.0],[8.8,1.2]]],"sent_kbit_s":[700.0],\
"arrived_kbit_s":[690.0]}}}
"""


def test_trials_that_were_kept_long_ago_can_be_read(tmp_path: Path) -> None:
    file, asked = tmp_path / "trials.jsonl", NineGoalsSettings(SCENARIOS["edge"]).document()
    file.write_text(KEPT)
    found = KeptTrials(file, NineGoalsResult).get(asked)
    assert found is not None
    assert (found.goals, found.first_leg_m, found.traces.goals) == (9, 4.0, (1,))
    assert found.traces.plans == (((5.0, 1.0), (8.8, 1.2)),)
    assert found.topics == (TopicRow("scan", 900, 0.01, 20.0, 5.0, 119.0, 180.0),)
    assert math.isnan(found.rtt_ms)
    assert found.traces.back_sent_kbit_s == ()


def test_what_is_asked_makes_another_trial(tmp_path: Path) -> None:
    file, edge = tmp_path / "trials.jsonl", SCENARIOS["edge"]
    KeptTrials(file, NineGoalsResult).put(NineGoalsSettings(edge).document(), RESULT)
    for other in (NineGoalsSettings(edge, seed=2), NineGoalsSettings(edge, goals=1)):
        assert KeptTrials(file, NineGoalsResult).get(other.document()) is None


@pytest.mark.slow
def test_figures_are_drawn_also_of_trials_that_lack_things(tmp_path: Path) -> None:
    whole = replace(RESULT, topics=ROWS, traces=TRACES)
    hit = replace(whole, scenario="embedded", completed=False, topics=(), traces=NineGoalsTraces())
    files = draw_figures([whole, replace(whole, seed=2), hit], building(), tmp_path / "new")
    assert [file.stem for file in files] == ["fig36-paths", "fig37-throughput", "fig38-loss", "fig39-periods", "times"]
    for file in files:
        with Image.open(file) as picture:
            assert len(set(picture.convert("L").resize((200, 100)).tobytes())) > 20  # something is on it
    with pytest.raises(ValueError, match="no trial"):
        draw_figures([], building(), tmp_path)


def test_a_run_of_kept_trials_only_prints_their_tables(tmp_path: Path) -> None:
    file = tmp_path / "trials.jsonl"
    settings = replace(SCENARIOS["edge"], params={"delay": {"compensation": "measured"}})
    KeptTrials(file, NineGoalsResult).put(NineGoalsSettings(settings).document(), replace(RESULT, topics=ROWS))
    line = ["lab", "run", "navigation", "--scenario", "edge", "--trials", "1", "--keep", str(file)]
    done = CliRunner().invoke(app, line, env={"COLUMNS": "200"})
    assert done.exit_code == 0, done.output
    assert "edge, seed 1: completed, 100.0 s (kept)" in done.output
    for table in ("Table 6", "Table 7", "Figs. 38 and 39"):
        assert table in done.output
    said = json.loads(CliRunner().invoke(app, [*line, "--json"]).stdout)
    assert said["topics"][0] == {**said["topics"][0], "scenario": "edge", "topic": "cmd_vel", "lost": 0.01}


def test_an_unknown_scenario_is_refused() -> None:
    done = CliRunner().invoke(app, ["lab", "run", "navigation", "--scenario", "moon"])
    assert done.exit_code == 2
    assert "there is no scenario 'moon'; there are embedded, edge, commercial, private" in done.output


@pytest.mark.slow
def test_a_robot_is_driven_to_the_first_goal_by_a_service_of_its_own() -> None:
    with NineGoalsTrial(NineGoalsSettings(SCENARIOS["commercial"], goals=1)) as trial:
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
    assert len(result.traces.way) > 20
    assert math.dist(result.traces.way[-1], (goal.x, goal.y)) < 0.6
    # what was under way when the counting began arrives in it: little less or more than what was sent
    assert sum(result.traces.sent_kbit_s) > 0
    assert sum(result.traces.arrived_kbit_s) == pytest.approx(sum(result.traces.sent_kbit_s), rel=0.1)
    assert NineGoalsResult.of(result.document(traces=True)).traces.way == result.traces.way


@pytest.mark.slow
def test_on_the_robots_own_computer_the_service_gets_no_more_than_that_has() -> None:
    scarce = replace(SCENARIOS["embedded"], cpu=0.03)  # far less than it needs
    with NineGoalsTrial(NineGoalsSettings(scarce, goals=1, drive_limit_s=12.0)) as trial:
        result = trial.drive()
    assert result.service_cpu < 0.06
    assert not result.completed
