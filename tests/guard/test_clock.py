"""The clocks see a suspend: whose time stood still meanwhile would take what was said before it for fresh."""

import time

import pytest

from skytether.guard import clock
from skytether.robot.agent.clocks import read_clocks


@pytest.fixture
def slept(monkeypatch):
    """The machine slept for ten hours: of its clocks only CLOCK_BOOTTIME has gone on."""
    shown = {time.CLOCK_BOOTTIME: 36_100.0, time.CLOCK_MONOTONIC: 100.0}
    monkeypatch.setattr(time, "clock_gettime", shown.__getitem__)
    monkeypatch.setattr(time, "monotonic", lambda: 100.0)


def test_guard_gate_and_agent_count_the_time_in_which_the_machine_slept(slept):
    assert clock.now() == 36_100.0
    assert read_clocks() == (100.0, 36_100.0)
