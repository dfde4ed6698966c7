"""The safety event record, as people and programs read it."""

import json

from typer.testing import CliRunner

from skytether.cli.app import app
from skytether.guard.record import encode

EVENTS = [
    {"n": 0, "wall": 1.7e9, "at": 5.0, "boot": "x", "who": "person", "what": "stop", "detail": "somebody fell"},
    {"n": 1, "wall": 1.7e9 + 60, "at": 65.0, "boot": "x", "who": "gate", "what": "death", "detail": "ended"},
    {"n": 2, "wall": 1.7e9 + 90, "at": 95.0, "boot": "x", "who": "person", "what": "reset", "lost_before": 3},
]


def show(*arguments):
    return CliRunner().invoke(app, ["robot", "safety-log", *arguments])


def test_what_happened_is_shown_oldest_first(tmp_path):
    record = tmp_path / "record"
    record.write_bytes(b"".join(encode(event) for event in reversed(EVENTS)) + bytes(512))
    lines = show("--record", str(record)).stdout.splitlines()
    assert [" ".join(line.split()[2:]) for line in lines[:3]] == [
        "person stop somebody fell",
        "gate death ended",
        "person reset",
    ]
    assert "3 events were lost" in lines[3]
    found = json.loads(show("--record", str(record), "--json", "--last", "2").stdout)
    assert [event["what"] for event in found] == ["death", "reset"]


def test_the_record_of_a_robot_is_found_by_its_file(tmp_path):
    (tmp_path / "robot.yaml").write_text(
        f"safety: {{footprint: {{radius: 0.3}}, sensors: {{}}, folder: {tmp_path}/run}}\n"
    )
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "record").write_bytes(encode(EVENTS[0]))
    assert "somebody fell" in show(str(tmp_path / "robot.yaml")).stdout


def test_a_record_that_is_not_there_says_what_to_do(tmp_path):
    failed = show("--record", str(tmp_path / "none"))
    assert failed.exit_code == 1
    assert "--record" in failed.stderr
