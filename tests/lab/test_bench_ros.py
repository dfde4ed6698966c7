"""A talker and a listener of ROS 2 are measured, with Skytether between them and without, half a second each."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from skytether.cli.commands.lab.app import app as cli
from skytether.lab.bench.ros import BRIDGED, MESSAGES, PLAIN, _row, _Seen, bench_ros
from skytether.lab.ros2_python import PYTHON


@pytest.mark.slow
@pytest.mark.ros2
def test_talker_and_listener_are_measured(ros2: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PYTHON, ros2)
    plain, bridged = by_way = [bench_ros(0.5, [way]) for way in (PLAIN, BRIDGED)]
    for rows in by_way:
        assert [row.message for row in rows] == [flow.name for flow in MESSAGES]
    for row, flow in zip(plain, MESSAGES, strict=True):
        assert 0 < row.sent <= flow.hz * 0.5 + 1
        assert row.delivered == row.sent  # reliable, on one machine
        assert row.p50_ms is not None
        assert 0 < row.p50_ms < 500
        assert row.nodes_us > 0
        assert row.robot_us == row.service_us == row.ends_rest == 0
    for row in bridged:
        assert row.way == BRIDGED
        assert row.delivered > 0  # of what cannot be passed on at once the newest is
        assert row.ends_rest > 0
    # In half a second on a busy machine an end may take less than at rest.
    assert any(row.robot_us for row in bridged)
    assert any(row.service_us for row in bridged)


def test_a_message_costs_what_is_used_beyond_rest() -> None:
    rest = _Seen(2.0, set(), 0, (), nodes_s=0.2, ends_s=(0.1, 0.3))
    seen = _Seen(2.0, {0}, 100, (0.001, 0.003), nodes_s=0.5, ends_s=(0.2, 0.7))
    row = _row(BRIDGED, 0, seen, rest)
    assert (row.sent, row.delivered) == (100, 2)
    assert (row.nodes_us, row.service_us, row.robot_us) == (3000.0, 1000.0, 4000.0)
    assert (row.nodes_rest, row.ends_rest) == (0.1, 0.2)


def test_what_is_missing_is_said_with_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PYTHON, "/nowhere/python")
    done = CliRunner().invoke(cli, ["bench", "ros"])
    assert done.exit_code == 1
    assert "/nowhere/python: No such file" in done.output
    assert "make ros2" in done.output
