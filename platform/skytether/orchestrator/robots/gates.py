"""What robots say of the gates before their wheels, with an instance or without: the last of each, while it is fresh.

Any orchestrator may be told, and what came in a moment is written together; the one that leads exports it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

from skytether.api.rest import GateReport

from ..access.access import Principal
from ..domain.errors import ForbiddenError
from ..store.database import GateRow
from ..store.store import Store


class Gates:
    """One row for each registered robot. Safe from any thread.

    Args:
        store: Where they are kept.
        silent: Seconds after which the last that a robot said is not how its gate is any more.
        clock: Seconds since the epoch.
    """

    def __init__(self, store: Store, silent: float, clock: Callable[[], float]) -> None:
        self._store = store
        self._silent = silent
        self._clock = clock
        self._heard: dict[str, GateRow] = {}
        """By robot, what is not in the database yet."""
        self._taking = threading.Lock()
        self._writing = threading.Lock()

    def receive_report(self, by: Principal, robot: str, report: GateReport) -> None:
        """Hear a robot.

        Raises:
            ForbiddenError: It is somebody else.
        """
        if by.robot != robot:
            raise ForbiddenError(f"only robot '{robot}' itself can say how its gate is")
        self.keep_report(robot, report)

    def keep_report(self, robot: str, report: GateReport) -> None:
        """The same of what came with a renewal."""
        with self._taking:
            self._heard[robot] = GateRow(robot, self._clock(), report)

    def write(self) -> None:
        """Bring everything that was heard into the database; if that fails, it is kept for the next time."""
        with self._writing:
            with self._taking:
                heard, self._heard = self._heard, {}
            try:
                if heard:
                    self._store.save_gates(heard.values())
                heard = {}
            finally:
                with self._taking:
                    self._heard = heard | self._heard

    def all(self) -> dict[str, GateRow]:
        """By robot, when it said something last, and what, while that is fresh."""
        rows = self._store.gates()
        with self._taking:
            heard = dict(self._heard)
        # Of a robot that nobody registered nothing is kept, so nothing is shown until then either.
        rows |= {robot: row for robot, row in heard.items() if robot in rows or self._store.robot(robot) is not None}
        now = self._clock()
        # Either way: a clock that was set back must not keep what was said for as long as that.
        return {
            robot: row if abs(now - row.at) <= self._silent else replace(row, report=None)
            for robot, row in rows.items()
        }

    def fresh(self) -> dict[str, GateReport]:
        """By robot, what is known now."""
        return {robot: row.report for robot, row in self.all().items() if row.report is not None}
