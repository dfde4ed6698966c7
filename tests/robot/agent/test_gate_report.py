"""The robot says how its gate is, with or without an instance: soon after a change, and again before it is unknown."""

from __future__ import annotations

from itertools import pairwise

import pytest

from skytether.api.client import ApiError, Unreachable
from skytether.api.rest import GateReport, Problem
from skytether.orchestrator.config.settings import Timing
from skytether.robot.agent.gate_report import AGAIN_S, PERIOD_S, GateReporter

CLEAR = GateReport(answers=True, hand="agent", zone="free")
STOPPED = GateReport(answers=True, stopped="somebody fell", hand="nobody", zone="free")


class Robot:
    """A robot, its orchestrator and the time."""

    def __init__(self) -> None:
        self.now = 0.0
        self.gate = CLEAR
        self.told: list[tuple[float, GateReport]] = []
        self.error: Exception | None = None
        self.refused = 0
        self.says = GateReporter(self, "walker", lambda: self.gate, on_refused=self._refused, clock=lambda: self.now)

    def report_gate(self, name: str, report: GateReport) -> None:
        if self.error is not None:
            raise self.error
        assert name == "walker"
        self.told.append((self.now, report))

    def runs(self, seconds: float) -> None:
        for _ in range(round(seconds / PERIOD_S)):
            self.now += PERIOD_S
            self.says.step()

    def _refused(self) -> bool:
        self.refused += 1
        return True


def test_what_does_not_change_is_told_often_enough_to_count_as_known() -> None:
    robot = Robot()
    robot.runs(60)
    times = [at for at, _ in robot.told]
    assert max(later - earlier for earlier, later in pairwise(times)) <= AGAIN_S
    assert len(times) <= 60 / AGAIN_S + 5, "and not with each look"
    assert Timing().gate_silent >= 2 * AGAIN_S + 5, "one that is lost, and one whose request takes all of its time"


def test_a_change_is_told_at_the_next_look() -> None:
    robot = Robot()
    robot.runs(10)
    robot.gate = STOPPED
    robot.runs(PERIOD_S)
    assert robot.told[-1] == (robot.now, STOPPED)


@pytest.mark.parametrize("error", [Unreachable("no route"), ApiError(Problem(title="-", status=503))])
def test_what_was_not_heard_is_told_again(error: Exception) -> None:
    robot = Robot()
    robot.error = error
    robot.runs(PERIOD_S)
    robot.error = None
    robot.runs(PERIOD_S)
    assert robot.told == [(robot.now, CLEAR)]
    assert not robot.refused


def test_a_token_that_is_refused_is_looked_for_anew() -> None:
    """A robot that drives by itself asks for nothing else: nobody else would notice."""
    robot = Robot()
    robot.error = ApiError(Problem(title="-", status=401))
    robot.runs(PERIOD_S)
    assert robot.refused == 1
