"""Tells the orchestrator how the gate is, whether the robot holds an instance or not.

A robot that stands without one is just the robot that people ask about.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Protocol

from skytether.api.client import ApiError, Unreachable
from skytether.api.rest import GateReport
from skytether.robot.log_throttle import LogThrottle

_log = logging.getLogger(__name__)

PERIOD_S = 2.0
"""A change is told within that time and one request."""
AGAIN_S = 5.0
"""What did not change is told again: thrice within the time after which an orchestrator takes it for unknown."""
_REFUSED = 401


class ReportsGate(Protocol):
    """What this needs of `skytether.api.client.Client`."""

    def report_gate(self, name: str, report: GateReport) -> None:
        """How the robot's gate is; raises ApiError or Unreachable."""
        ...


class GateReporter:
    """Tells it again and again. For a thread of its own.

    Args:
        client: The orchestrator.
        robot: Its name.
        report: What is known of the gate now.
        on_refused: Called when the token was refused; what it gives does not matter, the next time is soon.
        clock: Monotonic seconds.
    """

    def __init__(
        self,
        client: ReportsGate,
        robot: str,
        report: Callable[[], GateReport],
        *,
        on_refused: Callable[[], object] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._client = client
        self._robot = robot
        self._report = report
        self._on_refused = on_refused
        self._clock = clock
        self._log_throttle = LogThrottle(_log)
        self._told: tuple[GateReport, float] | None = None

    def step(self) -> None:
        """Tell it once, if there is something to tell."""
        report, now = self._report(), self._clock()
        if self._told is not None and report == self._told[0] and now - self._told[1] < AGAIN_S - PERIOD_S / 2:
            return
        try:
            self._client.report_gate(self._robot, report)
        except (ApiError, Unreachable) as error:
            self._log_throttle.warn("told", f"the orchestrator does not hear how the gate is: {error}", now)
            if isinstance(error, ApiError) and error.problem.status == _REFUSED:
                self._on_refused()
            return
        self._told = report, now

    def run(self, ended: threading.Event) -> None:
        """Tell it until told to end."""
        while not ended.wait(PERIOD_S):
            try:
                self.step()
            except Exception as error:  # one strange answer must not be the last word on the gate
                self._log_throttle.warn("strange", f"how the gate is could not be told: {error!r}", self._clock())
