"""The interaction experiment: its numbers, and a part of a round with all that is real."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image
from typer.testing import CliRunner

from skytether.cli.app import app
from skytether.cli.output import console
from skytether.lab.follow_in_front import NAMES, SCENARIOS, FollowSettings, FollowTrial, sonar_cloud
from skytether.lab.follow_in_front_figures import draw_figures
from skytether.lab.follow_in_front_report import DRAWN_TOPICS, PERIODS_MS, SONAR, THESIS, summary, topics
from skytether.lab.follow_in_front_result import FollowResult, FollowTraces
from skytether.lab.trial.results import KeptTrials, TopicRow
from skytether.lab.world.lemniscate import Lemniscate
from skytether.lab.world.robot import RobotParams
from skytether.messages import Header, Odometry, Range, Time

ROWS = tuple(TopicRow(topic, 900, 0.01, 20.0, 5.0, PERIODS_MS[topic], 180.0) for topic in DRAWN_TOPICS)
CURVE = Lemniscate()
WAY = tuple((pose.x, pose.y + 0.1) for pose in map(CURVE.at, range(18)))
TRACES = FollowTraces(
    way=WAY, operator=WAY, sent_kbit_s=(4600.0, 4700.0), arrived_kbit_s=(4500.0, 4600.0),
    back_sent_kbit_s=(30.0, 31.0), back_arrived_kbit_s=(30.0, 30.0),
)  # fmt: skip
RESULT = FollowResult(
    scenario="edge", seed=1, completed=True, contacts=0, start_s=1.0, time_s=50.0, distance_m=18.5,
    mean_speed_m_s=0.37, rtt_ms=10.0, robot_cpu=0.1, service_cpu=0.2, service_memory_mb=300.0,
    message="following", topics=ROWS, round=1.0, lost=False, kte_m=0.11, deviation_max_m=0.2, following=0.98,
    up_mbit_s=4.65, up_arrived_mbit_s=4.55, down_mbit_s=0.03, down_arrived_mbit_s=0.03, traces=TRACES,
)  # fmt: skip


def test_scenarios_are_those_of_the_thesis() -> None:
    assert list(SCENARIOS) == list(THESIS)
    assert SCENARIOS["embedded"].params == {"face_rate": 5.0}
    for name in ("edge", "commercial"):
        scenario, (rtt_ms, jitter_ms) = SCENARIOS[name], THESIS[name]["rtt_ms"]
        assert (1000 * scenario.rtt_s, 1000 * scenario.jitter_s) == pytest.approx((rtt_ms, jitter_ms))
        assert scenario.cpu is None


def test_the_robot_has_the_topics_of_table_2_by_their_names() -> None:
    assert {*NAMES.values(), SONAR, "tf", "cmd_vel"} == {*PERIODS_MS}


def test_the_sonars_echoes_are_points_around_the_robot() -> None:
    params = RobotParams(sonar_angles=(0.0, math.pi / 2))
    heard = [(f"sonar_{i}", Range(Header(Time(7, 0)), range=reach)) for i, reach in enumerate((1.0, 2.0))]
    cloud = sonar_cloud([("odom", Odometry()), *heard], params)
    assert cloud is not None
    assert (cloud.header.stamp, cloud.header.frame_id) == (Time(7, 0), "base_link")
    # the robot is 0.70 m long and 0.50 m wide
    first, second = ((point.x, point.y) for point in cloud.points)
    assert first == pytest.approx((1.35, 0.0))
    assert second == pytest.approx((0.0, 2.25))
    assert sonar_cloud([("odom", Odometry())], params) is None


def test_trials_are_summed_up_by_scenario_beside_their_topics() -> None:
    astray = replace(RESULT, seed=3, completed=False, lost=True, kte_m=0.9)
    (row,) = summary([RESULT, replace(RESULT, seed=2, kte_m=0.13), astray])
    assert (row["trials"], row["completed"], row["kte_m"], row["kte_m_std"]) == (3, 2, 0.12, 0.014)
    assert (row["up_mbit_s"], row["following"]) == (4.65, 0.98)
    image = topics([RESULT])[-1]
    assert (image["topic"], image["ideal_ms"], image["lost"]) == ("usb_cam/image_raw/compressed", 66.0, 0.01)


def test_a_kept_trial_is_as_it_was(tmp_path: Path) -> None:
    file, asked = tmp_path / "trials.jsonl", FollowSettings(SCENARIOS["edge"]).document()
    KeptTrials(file, FollowResult).put(asked, RESULT)
    kept = KeptTrials(file, FollowResult)
    again = kept.get(asked)
    assert again is not None
    assert again.traces.operator == tuple((round(x, 5), round(y, 5)) for x, y in WAY)
    assert replace(again, traces=TRACES, robot_memory_mb=0.0) == replace(RESULT, robot_memory_mb=0.0)
    assert kept.get(FollowSettings(SCENARIOS["edge"], share=0.5).document()) is None


@pytest.mark.slow
def test_figures_are_drawn_also_of_trials_that_lack_things(tmp_path: Path) -> None:
    bad = replace(RESULT, scenario="embedded", completed=False, topics=(), traces=FollowTraces(), kte_m=math.nan)
    files = draw_figures([RESULT, replace(RESULT, seed=2), bad], tmp_path / "new")
    assert [file.stem for file in files] == [
        "ways", "fig31-throughput", "fig32-loss", "fig33-periods", "times", "kte",
    ]  # fmt: skip
    for file in files:
        with Image.open(file) as picture:
            assert len(set(picture.convert("L").resize((200, 100)).tobytes())) > 20  # something is on it
    with pytest.raises(ValueError, match="no trial"):
        draw_figures([], tmp_path)


def test_a_run_of_kept_trials_only_prints_their_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console, "width", 200)  # whatever the environment said when it was made
    file = tmp_path / "trials.jsonl"
    settings = replace(SCENARIOS["edge"], params={"predict": True})
    KeptTrials(file, FollowResult).put(FollowSettings(settings).document(), RESULT)
    line = ["lab", "run", "follow-in-front", "--scenario", "edge", "--trials", "1", "--keep", str(file)]
    done = CliRunner().invoke(app, line)
    assert done.exit_code == 0, done.output
    assert "edge, seed 1: completed, KTE 0.110 m, 50.0 s (kept)" in done.output
    for words in ("0.154 ± 0.0029", "Table 3", "Figs. 32 and 33", "usb_cam/image_raw/compressed", "4.54"):
        assert words in done.output
    said = json.loads(CliRunner().invoke(app, [*line, "--json"]).stdout)
    assert said["summary"][0]["kte_m"] == 0.11


def test_a_trial_that_was_not_completed_is_an_error_that_says_how_it_ended(tmp_path: Path) -> None:
    file = tmp_path / "trials.jsonl"
    settings = replace(SCENARIOS["edge"], params={"predict": False})
    bad = replace(RESULT, completed=False, lost=True, round=0.4)
    KeptTrials(file, FollowResult).put(FollowSettings(settings).document(), bad)
    line = ["lab", "run", "follow-in-front", "--scenario", "edge", "--trials", "1", "--keep", str(file)]
    done = CliRunner().invoke(app, [*line, "--no-predict"], env={"COLUMNS": "200"})
    assert done.exit_code == 1
    assert "1 of 1 trials were not completed, first edge with seed 1: 40% of the round" in done.output
    assert "the operator lost the robot" in done.output


def test_an_unknown_scenario_is_refused() -> None:
    done = CliRunner().invoke(app, ["lab", "run", "follow-in-front", "--scenario", "private"])
    assert done.exit_code == 2
    assert "there is no scenario 'private'; there are embedded, edge, commercial" in done.output


@pytest.mark.slow
def test_a_robot_is_steered_a_part_of_the_round_by_who_walks_behind_it(gl: None) -> None:
    with FollowTrial(FollowSettings(SCENARIOS["commercial"], share=0.2, drive_limit_s=40.0)) as trial:
        result = trial.drive()
    assert result.completed, result
    assert 0.2 <= result.round < 0.4
    assert result.kte_m < 0.17
    assert result.rtt_ms > 100
    assert result.service_cpu > 0
    rows = {row.topic: row for row in result.topics}
    assert {*DRAWN_TOPICS, "status"} <= rows.keys()
    assert result.up_mbit_s > 50 * result.down_mbit_s > 0
    assert len(result.traces.way) == len(result.traces.operator) > 20
