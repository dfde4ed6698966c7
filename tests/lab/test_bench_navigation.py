"""``skytether lab bench navigation --delays``: what is driven where, and what is said of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from skytether.cli.commands.lab import navigation
from skytether.cli.commands.lab.app import app

ROOM = """
name: room
walls: [[0, 0, 4, 0], [4, 0, 4, 2.4], [4, 2.4, 0, 2.4], [0, 2.4, 0, 0]]
boxes: [{name: post, at: [2, 0.5], size: [0.2, 0.6]}]
starts: [[0.7, 1.2, 0]]
goals: [[3.2, 1.2, 0]]
people: [{name: idler, way: [[2, 1.2], [2, 1.3]], speed: 0.1}]
"""


def bench(*arguments: str) -> Any:
    return CliRunner().invoke(app, ["bench", "navigation", *arguments])


@pytest.fixture
def room(tmp_path: Path) -> Path:
    file = tmp_path / "room.yaml"
    file.write_text(ROOM)
    return file


def test_what_cannot_be_driven_is_said(room: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.yaml"
    broken.write_text("walls: []\n")
    for arguments, sentence in (
        (["--plan", str(room)], "--plan is for --delays"),
        (["--jitter-only"], "--jitter-only is for --delays"),
        (["--delays", "--plan", str(broken)], "goals is missing"),
        (["--delays", "--plan", str(room), "--goals", "2"], "--goals 2 is too many: the plan 'room' has 1"),
        (["--goals", "10"], "the plan 'building' has 9"),
    ):
        result = bench(*arguments)
        assert result.exit_code == 2
        assert sentence in " ".join(result.stderr.split())


def test_without_a_plan_all_goals_of_the_building_are_driven_to(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []

    def drive(name: str, **values: Any) -> dict[str, Any]:
        given.append((name, values.pop("plan").name, values["goals"], values["jitter_only"]))
        return {}

    monkeypatch.setattr(navigation, "bench_driving", drive)
    assert bench("--delays", "--json").exit_code == 0
    assert given == [("navigation-delays", "building", 9, False)]


def test_the_table_tells_the_test_and_no_verdict_that_is_not_there(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    link = {"round_trip": 0.2, "jitter": 0.04, "told": 0.2}
    test = {"error": "path_error", "test": "paired", "difference": 0.002, "low": 0.001, "high": 0.003, "t": 4, "p": 0.1}
    verdict = {"measured_beats_fixed": True, "measured_halves_off": False}
    found = {"rows": [], "fixed_against_measured": [{**link, **test}], **verdict}
    monkeypatch.setattr(navigation, "bench_driving", lambda _, **__: found)
    shown = " ".join(bench("--delays", "--plan", str(room), "--jitter-only").stderr.split())
    assert "path_error of fixed less measured, paired by seed: 2.00 mm, 1.00 to 3.00 (95 %)" in shown
    assert "within 5 %" not in shown
    assert "half the path error of none: no." in shown


@pytest.mark.slow
def test_a_plan_of_ones_own_is_driven_over_the_link_with_jitter_without_its_people(room: Path) -> None:
    result = bench("--delays", "--plan", str(room), "--jitter-only", "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert (found["plan"], found["goals"], found["runs"]) == ("room", 1, 1)
    rows = {(row["round_trip"], row["compensation"]): row for row in found["rows"]}
    assert list(rows) == [(0.0, "measured"), (0.2, "off"), (0.2, "fixed"), (0.2, "measured")]
    for wanted in ((0.0, "measured"), (0.2, "fixed"), (0.2, "measured")):
        assert (rows[wanted]["state"], rows[wanted]["contacts"]) == ("succeeded", 0)
    assert rows[0.0, "measured"]["prediction_error"] < 1e-9 < rows[0.2, "measured"]["prediction_error"]
    assert "time_within_bar" not in found
