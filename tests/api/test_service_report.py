"""What is read of a file that a service wrote, whatever it wrote."""

from __future__ import annotations

import json
from typing import Any

import pytest

from skytether.api.service_report import MOST_CHARACTERS, MOST_REPORTS, ServiceReport, pull_reports, write_reports


def row(number: Any = 1, code: Any = "no_path", message: Any = "There is no way.") -> dict[str, Any]:
    return {"number": number, "code": code, "message": message}


def test_what_is_written_is_read() -> None:
    reports = tuple(ServiceReport(number, "no_path", f"grün {number}") for number in range(3, 3 + MOST_REPORTS))
    assert pull_reports(json.loads(write_reports(reports))) == reports


@pytest.mark.parametrize(
    "wrong",
    [
        row(number=0),
        row(number=2**31),
        row(number=True),
        row(number="1"),
        row(code=""),
        row(code="No Path"),
        row(code="x" * 64),
        row(code="a\n"),
        row(message=None),
        {},
        [],
        None,
    ],
)
def test_a_wrong_report_is_left_out_and_the_others_stay(wrong: Any) -> None:
    assert pull_reports({"reports": [row(1), wrong, row(2)]}) == tuple(
        ServiceReport(number, "no_path", "There is no way.") for number in (1, 2)
    )


@pytest.mark.parametrize("document", [None, [], "x", {}, {"reports": None}, {"reports": {}}, {"reports": "x"}])
def test_another_document_has_none(document: Any) -> None:
    assert pull_reports(document) == ()


def test_only_the_newest_are_read_each_number_once_and_in_order() -> None:
    rows = [row(number) for number in (99, 2, 1, 7, 6, 5, 4, 4, 3)]
    assert [report.number for report in pull_reports({"reports": rows})] == [1, 2, 3, 4, 5, 6, 7]


def test_a_message_is_one_line_of_bounded_length_that_obeys_no_code() -> None:
    (report,) = pull_reports({"reports": [row(message="a\x1b[2J\n\x00\ud800\u202e" + "\x07" * 1000)]})
    assert report.message.startswith("a\\x1b[2J\\n\\x00\\ud800\\u202e\\x07")
    assert len(report.message) == MOST_CHARACTERS
