"""A talker and a listener of ROS 2 are measured, for half a second each."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from skytether.cli.commands.lab.lab import app as cli
from skytether.lab.bench.ros import MESSAGES, PLAIN, bench_ros
from skytether.lab.bench.ros2_node import PYTHON


@pytest.mark.slow
@pytest.mark.ros2
def test_talker_and_listener_are_measured(ros2: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PYTHON, ros2)
    rows = bench_ros(0.5, [PLAIN])
    assert [row.message for row in rows] == [flow.name for flow in MESSAGES]
    for row, flow in zip(rows, MESSAGES, strict=True):
        assert abs(row.sent - flow.hz * 0.5) <= 1
        assert row.delivered == row.sent  # reliable, on one machine
        assert row.p50_ms is not None
        assert 0 < row.p50_ms < 500
        assert row.nodes_us > 0
        assert row.robot_us == row.service_us == 0


def test_what_is_missing_is_said_with_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PYTHON, "/nowhere/python")
    done = CliRunner().invoke(cli, ["bench", "ros"])
    assert done.exit_code == 1
    assert "/nowhere/python: No such file" in done.output
    assert "make ros2" in done.output
