"""Trying navigation in the building: what is read, and which runs are good. A whole run is in tests/e2e."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from skytether.cli.app import app
from skytether.lab.building_run import Driven, ParamsError, read_params
from skytether.lab.world.contacts import Contact, Touched

WAY = Path("way.png")
GOOD = Driven("succeeded", "ok", "All goals are reached.", 1, 1, 20.0, 4.0, (), (WAY,))


def test_files_are_looked_for_beside_the_parameters(tmp_path: Path) -> None:
    file = tmp_path / "drive.yaml"
    file.write_text("map: maps/office.yaml\nkeep_out: /elsewhere/zone.yaml\nrounds: 2\n")
    params, folders = read_params(file)
    assert params == {"map": str(tmp_path / "maps" / "office.yaml"), "keep_out": "/elsewhere/zone.yaml", "rounds": 2}
    assert folders == (tmp_path / "maps", Path("/elsewhere"))


@pytest.mark.parametrize("text", ["- 1\n", "a: [\n", ""])
def test_what_holds_no_parameters_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "drive.yaml"
    file.write_text(text)
    with pytest.raises(ParamsError, match=r"drive\.yaml"):
        read_params(file)
    done = CliRunner().invoke(app, ["lab", "run", "building", str(file)])
    assert done.exit_code == 2


def test_good_runs_end_with_the_goals_or_on_the_way_or_with_a_map() -> None:
    assert GOOD.wrong is None
    assert replace(GOOD, state="driving").wrong is None
    assert replace(GOOD, state="mapping", files=(Path("office.yaml"), WAY)).wrong is None


def test_a_run_that_stands_at_the_end_or_never_moved_or_touched_something_is_none() -> None:
    broken = replace(GOOD, state="standing", code="map_broken", message="It is torn.", distance_m=0.0)
    assert broken.wrong == "map_broken: It is torn."
    assert replace(GOOD, state="standing", code="no_scan", message="None came.").wrong == "no_scan: None came."
    assert replace(GOOD, state="failed", code="gave_up", message="Enough.").wrong == "gave_up: Enough."
    assert "did not move" in str(replace(GOOD, state="waiting", distance_m=0.0).wrong)
    assert "did not move" in str(replace(GOOD, state="driving", distance_m=0.0).wrong)
    assert "no map was saved" in str(replace(GOOD, state="mapping").wrong)
    hit = Contact(0, Touched.WALL, "wall 3", 1.0, 1.1, 0.0, 0.0, 5.0)
    assert replace(GOOD, contacts=(hit,)).wrong == "the robot touched wall 3"
