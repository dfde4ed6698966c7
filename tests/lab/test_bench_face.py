"""Rendered faces and what is said of them."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from typer.testing import CliRunner

from skytether.cli.commands.lab.app import app
from skytether.lab.bench import face as bench
from skytether_services.follow_in_front.bench_face import track_faces


@pytest.mark.slow
def test_a_head_that_turns_is_seen_to_turn(gl: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "load", lambda _name, _extra: track_faces)
    found = bench.bench_face((0.9,), math.radians(9), [1])
    assert found["pictures"] == 40
    assert found["detected_percent"] == 100
    assert found["yaw_error_mean_deg"] < 3.2
    assert 60 < found["face_pixels"] < 120
    assert 30 < found["distances"][0]["picture_kb"] < 60
    assert "photographs" in found["faces"]


def test_without_a_face_there_is_no_error_to_tell() -> None:
    nothing = bench.row_of([math.nan], [track_faces([_grey()], 1.0)[0]])
    assert nothing["detected_percent"] == 0
    assert nothing["yaw_error_mean_deg"] is None


def test_what_cannot_be_is_refused() -> None:
    result = CliRunner().invoke(app, ["bench", "face", "--degrees", "80"])
    assert result.exit_code == 2
    assert "60" in result.output


def test_the_command_prints_one_object(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []
    monkeypatch.setattr(bench, "bench_face", lambda *given: asked.append(given) or {"pictures": 0})
    result = CliRunner().invoke(app, ["bench", "face", "--distance", "1.1", "--seeds", "2"])
    assert json.loads(result.stdout) == {"pictures": 0}
    assert asked == [([1.1], math.radians(40), range(1, 3))]


def _grey() -> bytes:
    import io

    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.full((480, 640, 3), 120, np.uint8)).save(buffer, "JPEG")
    return buffer.getvalue()
