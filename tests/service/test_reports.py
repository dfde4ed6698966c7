"""What a service reports, on its side: the file beside its ready file."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import pytest

from skytether.api.service_report import MOST_REPORTS, pull_reports
from skytether.service.reports import Reports


def test_without_a_file_they_are_only_kept() -> None:
    reports = Reports()
    reports.add("lost", "The robot is lost.")
    assert [(r.number, r.code, r.message) for r in reports.recent] == [(1, "lost", "The robot is lost.")]


def test_the_file_holds_the_newest_in_order(tmp_path: Path) -> None:
    reports = Reports()
    reports.path = tmp_path / "reports.json"
    for number in range(20):
        reports.add("lost", f"for the {number}. time")
    found = pull_reports(json.loads(reports.path.read_bytes()))
    assert found == tuple(reports.recent)
    assert [report.number for report in found] == list(range(21 - MOST_REPORTS, 21))
    assert [path.name for path in tmp_path.iterdir()] == ["reports.json"]


def test_the_same_again_is_not_reported_again() -> None:
    reports = Reports()
    for message in ("a", "a", "b", "a"):
        reports.add("lost", message)
    assert [report.message for report in reports.recent] == ["a", "b", "a"]


@pytest.mark.parametrize("code", ["", "No", "no path", "1st", "x" * 64])
def test_a_wrong_code_is_the_author_s_mistake(code: str) -> None:
    with pytest.raises(ValueError, match="small letters"):
        Reports().add(code, "why")


def test_a_full_disk_ends_no_service(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    reports = Reports()
    reports.path = tmp_path / "gone" / "reports.json"
    with caplog.at_level(logging.WARNING):
        reports.add("lost", "why")
    assert "a report cannot be written" in caplog.text
