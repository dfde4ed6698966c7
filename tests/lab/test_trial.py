"""What experiments share: scenarios, kept trials, rows of devices, notes for figures."""

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from skytether.emulator.udp_link import LinkCounters
from skytether.lab.trial.report import devices, summary
from skytether.lab.trial.results import KeptTrials, TopicRow, Traces, TrialResult
from skytether.lab.trial.scenario import Scenario, TrialSettings
from skytether.lab.trial.tracker import Tracker

EDGE = Scenario("edge", 0.03, 0.02, 0.005)
RESULT = TrialResult(
    scenario="edge", seed=1, completed=True, contacts=0, start_s=1.0, time_s=100.0, distance_m=41.0,
    mean_speed_m_s=0.41, rtt_ms=28.0, robot_cpu=0.1, service_cpu=0.2, service_memory_mb=300.0,
    message="The last goal was reached.", topics=(),
)  # fmt: skip


def test_a_scenario_is_halved_between_both_ways() -> None:
    up, down = (Scenario("x", rtt_s=0.2, jitter_s=0.02, loss=0.02).link(3, direction) for direction in (0, 1))
    assert up.delay + down.delay == pytest.approx(0.2)
    assert math.hypot(up.jitter, down.jitter) == pytest.approx(0.02)
    assert (1 - up.loss) * (1 - down.loss) == pytest.approx(0.98)
    assert up.seed != down.seed


def test_kept_trials_are_there_when_a_run_goes_on(tmp_path: Path) -> None:
    file, asked = tmp_path / "trials.jsonl", TrialSettings(EDGE).document()
    rows = (TopicRow("tf", 900, 0.01, 20.0, 5.0, 10.0, 18.0), TopicRow("scan", 90, 0.0, 20.0, 5.0, 100.0))
    traces = Traces(((1.0, 1.0), (5.0, 1.0)), (700.0,), (690.0,), (4.0,), (4.0,))
    result = replace(RESULT, topics=rows, traces=traces, rtt_ms=math.nan)
    kept = KeptTrials(file, TrialResult)
    assert kept.get(asked) is None
    kept.put(asked, result)
    again = KeptTrials(file, TrialResult).get(asked)
    assert again is not None
    assert math.isnan(again.rtt_ms)
    assert math.isnan(again.topics[1].period_p99_ms)
    assert again.topics[0] == rows[0]
    assert again.traces == traces
    assert KeptTrials(file, TrialResult).get(TrialSettings(EDGE, seed=2).document()) is None


def test_a_line_that_a_crash_cut_off_is_done_again_and_any_other_refused(tmp_path: Path) -> None:
    file = tmp_path / "trials.jsonl"
    one, two = (TrialSettings(EDGE, seed=seed).document() for seed in (1, 2))
    KeptTrials(file, TrialResult).put(one, RESULT)
    KeptTrials(file, TrialResult).put(two, RESULT)
    file.write_text(file.read_text()[:-20])
    kept = KeptTrials(file, TrialResult)
    assert kept.get(one) is not None
    assert kept.get(two) is None
    kept.put(two, RESULT)
    assert KeptTrials(file, TrialResult).get(two) is not None
    assert len(file.read_text().splitlines()) == 2
    file.write_text('{"a": 1}\n')
    with pytest.raises(ValueError, match="line 1 of"):
        KeptTrials(file, TrialResult)


def test_no_number_is_written_as_something_that_json_lacks() -> None:
    said = json.dumps(replace(RESULT, rtt_ms=math.nan).document(), allow_nan=False)
    assert json.loads(said)["rtt_ms"] is None
    assert "traces" not in json.loads(said)


def test_robot_and_service_on_one_computer_are_one_device() -> None:
    first = replace(RESULT, robot_memory_mb=400.0)
    both = [first, replace(first, seed=2, service_cpu=0.4)]
    (row,) = summary(both, ("robot_cpu", "robot_memory_mb", "service_cpu", "service_memory_mb"))
    assert devices(row, on_robot=False) == [
        ("robot", (pytest.approx(10.0), 0.0), (400.0, 0.0)),
        ("service", (pytest.approx(30.0), pytest.approx(14.1)), (300.0, 0.0)),
    ]
    assert devices(row, on_robot=True) == [("robot", (pytest.approx(40.0), pytest.approx(14.1)), (700.0, 0.0))]


def test_places_are_noted_each_tenth_of_a_second_and_what_passes_each_second_both_ways() -> None:
    robot = SimpleNamespace(pose=(0.0, 0.0, 0.0))
    passed = {"up": LinkCounters(), "down": LinkCounters()}
    tracker = Tracker(robot, lambda: passed)  # type: ignore[arg-type]
    assert [tracker.sample(now) for now in (0.0, 0.05, 0.1)] == [True, False, True]
    robot.pose = (0.7, 0.2, 0.0)
    passed["up"].bytes_received, passed["up"].bytes_forwarded = 500_000, 250_000
    passed["down"].bytes_received, passed["down"].bytes_forwarded = 5_000, 4_000
    assert tracker.sample(2.0)
    traces = Traces(**tracker.traces())
    assert traces.way == ((0.0, 0.0), (0.0, 0.0), (0.7, 0.2))
    # 500,000 bytes within 2 s are 2 Mbit/s
    assert (traces.sent_kbit_s, traces.arrived_kbit_s) == ((2000.0,), (1000.0,))
    assert (traces.back_sent_kbit_s, traces.back_arrived_kbit_s) == ((20.0,), (16.0,))
