import json

import pytest
from typer.testing import CliRunner

from skytether.cli.app import app

STATUS = {
    "stopped": "",
    "hand": "agent",
    "zone": "clear",
    "way_m": None,
    "linear_m_s": 0.1,
    "angular_rad_s": 0.0,
    "troubles": [],
}


@pytest.mark.parametrize(
    ("changes", "ahead"),
    [
        ({}, "ahead     clear: nothing near"),
        ({"zone": "slow", "way_m": 0.4}, "ahead     slow: 0.40 m to the stop zone"),
        ({"zone": "unknown"}, "ahead     unknown: not all of it is seen"),
    ],
)
def test_what_is_not_seen_is_called_unknown(monkeypatch, changes, ahead):
    monkeypatch.setattr("skytether.robot.safety.client.ask", lambda *_: STATUS | changes)
    assert ahead in CliRunner().invoke(app, ["robot", "gate-status"]).stdout.splitlines()
    shown = CliRunner().invoke(app, ["robot", "gate-status", "--json"]).stdout
    assert json.loads(shown)["zone"] == (STATUS | changes)["zone"]
