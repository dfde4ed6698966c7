"""How long steps take, as a service says it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from skytether.api.grant import Grant
from skytether.api.service_report import pull_reports, pull_step_s
from skytether.service.reports import Reports
from skytether.service.step_times import StepTimes


def noted(*seconds: float, at: float = 100.0) -> StepTimes:
    times = StepTimes()
    for one in seconds:
        times.note(at, one)
    return times


def test_of_twenty_steps_nineteen_took_no_longer() -> None:
    assert noted(*[0.001] * 19, 1.0).typical(100.0) == 0.001
    assert noted(*[0.001] * 18, 0.5, 1.0).typical(100.0) == 0.5
    assert noted(0.25).typical(100.0) == 0.25
    assert StepTimes().typical(100.0) is None


def test_what_was_long_ago_does_not_count_unless_there_is_little_else() -> None:
    times = noted(*[1.0] * 50)
    for _ in range(30):
        times.note(110.0, 0.002)
    assert times.typical(110.0) == 0.002
    seldom = noted(*[1.0] * 50)
    seldom.note(110.0, 0.002)
    assert seldom.typical(110.0) == 1.0


def test_it_is_told_again_when_it_has_changed() -> None:
    times = noted(*[0.010] * 20)
    assert times.news(100.0) == 0.010
    assert times.news(100.0) is None
    for _ in range(200):
        times.note(106.0, 0.0105)
    assert times.news(106.0) is None
    for _ in range(200):
        times.note(112.0, 0.020)
    assert times.news(112.0) == 0.020


def test_it_is_in_the_file_of_reports_and_neither_loses_the_other(tmp_path: Path) -> None:
    reports = Reports()
    reports.path = tmp_path / "reports.json"
    reports.report_step_time(0.0042)
    reports.add("lost", "why")
    document = json.loads(reports.path.read_bytes())
    assert pull_step_s(document) == 0.0042
    assert [report.code for report in pull_reports(document)] == ["lost"]


@pytest.mark.parametrize("told", [None, True, "1", -1, 1e9, float("nan"), [1], {}])
def test_what_is_no_such_number_is_nothing(told: object) -> None:
    assert pull_step_s({"step_s": told}) is None
    assert pull_step_s([told]) is None


def test_a_grant_speaks_of_it_only_where_it_is_wanted() -> None:
    grant = Grant(instance="i1", service="toy", robot="r", session_id="s", session_key="k", topics=())
    assert "step_times" not in json.loads(grant.model_dump_json()), "services made before take it, too"
    wanted = grant.model_copy(update={"step_times": True})
    assert Grant.model_validate_json(wanted.model_dump_json()).step_times
    assert Grant.model_validate_json(grant.model_dump_json()) == grant
