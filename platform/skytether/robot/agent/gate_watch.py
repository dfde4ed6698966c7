"""What the gate says of itself, asked once a second by a thread of the agent: for status, metrics, the orchestrator."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from skytether.api.rest import GateReport

from ..safety.client import GateError, ask

PERIOD_S = 1.0
_ANSWER_S = 2.0
_STOPPED = 200
_WORD = 32


class GateWatch:
    """Asks the gate.

    Args:
        folder: The gate's.
        ask: Puts a request.
    """

    def __init__(self, folder: Path, ask: Callable[[Path, dict[str, Any], float], dict[str, Any]] = ask) -> None:
        self._folder = folder
        self._ask = ask
        self.report = GateReport()

    def last(self) -> GateReport:
        """What it said last."""
        return self.report

    def step(self) -> None:
        """Ask once."""
        try:
            answer = self._ask(self._folder, {"do": "status"}, _ANSWER_S)
        except GateError:
            self.report = GateReport()
            return
        troubles = answer.get("troubles")
        self.report = GateReport(
            answers=True,
            stopped=str(answer.get("stopped") or "")[:_STOPPED],
            hand=str(answer.get("hand") or "")[:_WORD],
            zone=str(answer.get("zone") or "")[:_WORD],
            troubles=len(troubles) if isinstance(troubles, list) else 0,
        )

    def run(self, stop: threading.Event) -> None:
        """Ask until told to stop."""
        while not stop.is_set():
            self.step()
            stop.wait(PERIOD_S)
