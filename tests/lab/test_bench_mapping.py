from __future__ import annotations

import gzip
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from skytether.cli.commands.lab.app import app
from skytether.lab.bench.mapping import noisy
from skytether.lab.relations import relative


def test_noise_is_of_the_motions_size_and_its_seed() -> None:
    # 2,000 motions of 0.5 m ahead and 0.2 rad: sigma is 0.05 m along and across, and 0.02 rad.
    turn = 0.2 * np.arange(2001)
    steps = 0.5 * np.column_stack([np.cos(turn), np.sin(turn)])
    truth = np.column_stack([np.vstack([np.zeros((1, 2)), np.cumsum(steps[:-1], axis=0)]), turn])
    got = noisy(truth, 3)
    error = relative(got[:-1], got[1:]) - [0.5, 0, 0.2]
    np.testing.assert_allclose(error.std(axis=0), [0.05, 0.05, 0.02], rtol=0.1)
    np.testing.assert_array_equal(got, noisy(truth, 3))
    assert not np.array_equal(got, noisy(truth, 4))
    standing = np.zeros((5, 3))
    np.testing.assert_array_equal(noisy(standing, 1), standing)


def test_what_cannot_be_used_is_said(tmp_path: Path) -> None:
    log = tmp_path / "some.log"
    log.write_text("hello\n")
    result = CliRunner().invoke(app, ["bench", "mapping", str(log), "--odometry", "wheels"])
    assert result.exit_code == 2
    result = CliRunner().invoke(app, ["bench", "mapping", str(log)])
    assert result.exit_code == 1
    assert not result.stdout


@pytest.mark.slow
@pytest.mark.data
def test_the_first_minutes_of_a_real_log(data_dir: Path, tmp_path: Path) -> None:
    laser = data_dir / "laser"
    with gzip.open(laser / "freiburg-079-corrected.log.gz", "rt") as file:
        lines = [line for line in file if line.startswith("FLASER")]
    log = tmp_path / "part.log"
    log.write_text("".join(lines[:900]))
    arguments = ["bench", "mapping", str(log), "--relations", str(laser / "freiburg-079.relations.gz")]
    arguments += ["--stamp-offset", "-1211.44", "--save", str(tmp_path / "map.yaml")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert figures["relations"] > 100
    assert figures["translation_mean_m"] < 0.06
    assert figures["rotation_mean_deg"] < 0.8
    assert figures["seeds"] == 1
    assert (tmp_path / "map.png").stat().st_size > 1000
    assert (tmp_path / "map.pgm").read_bytes().startswith(b"P5")


@pytest.mark.slow
@pytest.mark.data
def test_a_robot_is_tracked_on_the_map_of_the_way_before(data_dir: Path, tmp_path: Path) -> None:
    with gzip.open(data_dir / "laser" / "freiburg-079-corrected.log.gz", "rt") as file:
        lines = [line for line in file if line.startswith("FLASER")]
    log = tmp_path / "part.log"
    log.write_text("".join(lines[:600]))
    result = CliRunner().invoke(app, ["bench", "localisation", str(log), "--starts", "1"])
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert figures["position_mean_m"] < 0.15
    assert figures["heading_mean_deg"] < 2
    assert figures["lost"] == 0
    assert figures["seeds"] == 1
