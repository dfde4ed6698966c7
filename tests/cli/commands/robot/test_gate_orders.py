import json
from typing import Any

import pytest
from typer.testing import CliRunner

from skytether.cli.app import app
from skytether.cli.commands.robot import gate_orders

STATUS: dict[str, Any] = {
    "stopped": "",
    "hand": "agent",
    "zone": "clear",
    "way_m": None,
    "linear_m_s": 0.1,
    "angular_rad_s": 0.0,
    "waiting": {},
    "beyond": [],
    "troubles": ["scan: is stale"],
    "kept": True,
    "not_permitted": ["locking memory is not permitted"],
    "pid": 8,
    "guard": {"pid": 7, "gate_restarts": 2, "troubles": ["the wheels cannot be told anything"], "not_permitted": []},
}
STATUS["guard"]["notes"] = ["the event record /run/x is on a tmpfs"]


@pytest.mark.parametrize(
    ("changes", "ahead"),
    [
        ({}, "ahead     clear: nothing near"),
        ({"zone": "slow", "way_m": 0.4}, "ahead     slow: 0.40 m to the stop zone"),
        ({"zone": "unknown"}, "ahead     unknown: not all of it is seen"),
    ],
)
def test_what_is_not_seen_is_called_unknown(monkeypatch, changes, ahead):
    monkeypatch.setattr("skytether.cli.commands.robot.gate_orders.ask", lambda *_: STATUS | changes)
    assert ahead in CliRunner().invoke(app, ["robot", "gate-status"]).stdout.splitlines()
    shown = CliRunner().invoke(app, ["robot", "gate-status", "--json"]).stdout
    assert json.loads(shown)["zone"] == (STATUS | changes)["zone"]


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({}, "guard     process 7, gate 8, after 2 deaths of the gate"),
        ({}, "trouble   the wheels cannot be told anything"),
        ({}, "note      locking memory is not permitted"),
        ({}, "note      the event record /run/x is on a tmpfs"),
        ({"guard": None}, "guard     does not answer; the gate stops the wheels itself"),
        (
            {"stopped": "x", "kept": False},
            "trouble   the emergency stop is not on disk: it would not outlive the guard",
        ),
    ],
)
def test_the_guards_part_is_shown(monkeypatch, changes, says):
    monkeypatch.setattr("skytether.cli.commands.robot.gate_orders.ask", lambda *_: STATUS | changes)
    shown = CliRunner().invoke(app, ["robot", "gate-status"])
    assert shown.exit_code == 0
    assert says in shown.stdout.splitlines()


def test_a_terminal_gets_no_codes_of_who_gave_the_reason_of_a_stop(monkeypatch, capsys):
    monkeypatch.setattr(gate_orders, "ask", lambda *_: {**STATUS, "stopped": "from afar: \x1b[2J"})
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    gate_orders.gate_status()
    assert "stopped   from afar: \\x1b[2J\n" in capsys.readouterr().out
