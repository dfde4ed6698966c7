"""Attacks on real processes: few here, each once; all of them are `skytether lab bench safety`."""

from __future__ import annotations

import pytest

from skytether.lab.bench.safety import attacks, bench_safety, estimate, select
from skytether.lab.safety import robot
from skytether.lab.safety.robot import LIMITS


def test_each_attack_has_a_name_of_its_own_and_can_be_chosen():
    names = [attack.name for attack in attacks()]
    assert len(names) == len(set(names))
    assert all(attack.what and attack.seconds > 0 for attack in attacks())
    for name in names:
        assert name in [attack.name for attack in select([name])]
    assert [attack.name for attack in select(["stop-reason"])] == [n for n in names if n.startswith("stop-reason-")]
    assert [attack.name for attack in select([])] == names
    with pytest.raises(ValueError, match="there is no attack 'nonsense'; there are: agent-killed, "):
        select(["nonsense"])


def test_all_attacks_fit_into_some_minutes():
    assert estimate(attacks(), 1) < 330


FEW = (
    "agent-killed",
    "gate-frozen-1",
    "gate-killed-thrice",
    "guard-frozen-1",
    "guard-gate-killed",
    "stop-gate-killed",
    "reset-agent-frozen",
    "wheels-gone-0.5",
    "pipe-full",
)
UNHURRIED = {"rate_hz": 20, "guard_s": 0.4, "limits": {**LIMITS, "max_gap_s": 0.4}}
"""What is promised, and what may be late, follows from these: a machine that others use too is no violation."""


@pytest.mark.slow
def test_some_attacks_on_real_processes():
    rows = list(bench_safety(select([*FEW, "suspend"]), 1, safety=UNHURRIED))
    assert [what for row in rows for what in row.what] == []
    assert len(rows) == len(FEW) + 3
    for row in rows:
        assert row.velocity_max_m_s > 0.4  # it did drive
        assert 0.5 < row.acceleration_max_m_s2 <= 2.0
        if row.attack != "wheels-gone-0.5":
            assert row.standstill_max_s is not None
            assert row.promised_s is not None
            assert 0 < row.standstill_max_s <= row.promised_s


@pytest.mark.slow
def test_some_attacks_on_a_robot_on_real_ros_2(ros2, monkeypatch):
    """What waits in a node's program that hangs is told nobody later, and who takes over from it makes no jump."""
    monkeypatch.setenv("SKYTETHER_ROS2_PYTHON", ros2)
    few = (
        "writer-killed",
        "writer-program-frozen-1",
        "writer-program-frozen-in-the-midst",  # and while the gate, or the writer, is killed
        "program-frozen-stop",
        "button-gate-frozen",
        "stranger",
    )
    rows = list(bench_safety(select([f"ros2-{name}" for name in few], with_ros2=True), 1, safety=UNHURRIED))
    assert [what for row in rows for what in row.what] == []
    assert len(rows) == len(few) + 2
    assert max(row.velocity_max_m_s for row in rows) > 0.4


@pytest.mark.slow
def test_what_is_not_staged_is_no_success(monkeypatch):
    """A robot that does not drive keeps every promise of standing; that is told as a violation."""
    monkeypatch.setattr(robot, "PATIENCE_S", 1.0)
    blind = {"sensors": {"another": {}}}
    (row,) = bench_safety(select(["agent-killed"]), 1, safety=blind)
    assert row.violations == 1
    assert row.what[0].startswith("stuck: not within 1 s: the robot drives")
