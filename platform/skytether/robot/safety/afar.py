"""Stop from afar, one way: orders of the orchestrator to stop are obeyed, once each. Nothing here can reset.

Only where the robot's own configuration says so (``safety.stop_from_afar``). An orchestrator that is away, or has no
order, changes nothing. An order that was obeyed is remembered over restarts of the agent, so that it does not stop the
robot again after a person has reset it.
"""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from skytether.api.client import ApiError, Unreachable
from skytether.api.rest import StopOrder
from skytether.robot.notices import Notices

from .client import GateError, stop

_log = logging.getLogger(__name__)

PERIOD_S = 2.0
"""Between two looks: half a request a second for each robot. An order is obeyed within that time and one request."""
FILE = "afar.json"
"""In the gate's folder: ids of orders that were obeyed."""
_REMEMBERED = 64
"""Orders; an orchestrator gives a robot one at a time."""


class Orders(Protocol):
    """What this needs of `skytether.api.client.Client`; every call raises ApiError or Unreachable."""

    def stop_order(self, name: str) -> StopOrder | None:
        """The last order."""
        ...

    def acknowledge_stop(self, name: str, order: str) -> StopOrder:
        """The robot stands."""
        ...


class StopFromAfar:
    """Looks for orders, obeys and acknowledges them. For a thread of its own.

    Args:
        client: The orchestrator.
        robot: Its name.
        folder: The gate's.
        stop: Stops the robot; raises GateError if nobody took it.
        clock: Monotonic seconds.
    """

    def __init__(
        self,
        client: Orders,
        robot: str,
        folder: Path,
        *,
        stop: Callable[[Path, str], dict[str, Any]] = stop,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._client = client
        self._robot = robot
        self._folder = folder
        self._stop = stop
        self._clock = clock
        self._notices = Notices(_log)
        self._obeyed = self._read()

    def step(self) -> None:
        """Look once."""
        try:
            order = self._client.stop_order(self._robot)
            if order is None or order.acknowledged_at is not None or order.robot != self._robot:
                return
            if order.id not in self._obeyed and not self._obey(order):
                return
            self._client.acknowledge_stop(self._robot, order.id)
        except (ApiError, Unreachable) as error:
            self._notices.say("orders", f"orders to stop cannot be heard of: {error}", self._clock())

    def run(self, ended: threading.Event) -> None:
        """Look until told to end."""
        while not ended.wait(PERIOD_S):
            try:
                self.step()
            except Exception as error:  # one strange answer must not be the last one that is read
                self._notices.say("strange", f"an order to stop could not be read: {error!r}", self._clock())

    def _obey(self, order: StopOrder) -> bool:
        try:
            self._stop(self._folder, f"stopped from afar by {order.by}: {order.reason}")
        except GateError as error:
            self._notices.say("gate", f"an order to stop could not be obeyed: {error}", self._clock())
            return False
        _log.warning("stopped from afar by %s: %s", order.by, order.reason)
        self._obeyed = [*self._obeyed, order.id][-_REMEMBERED:]
        self._write()
        return True

    def _read(self) -> list[str]:
        try:
            found = json.loads((self._folder / FILE).read_text())
        except (OSError, ValueError):
            return []
        return [str(one) for one in found][-_REMEMBERED:] if isinstance(found, list) else []

    def _write(self) -> None:
        part = self._folder / (FILE + ".new")
        try:
            part.write_text(json.dumps(self._obeyed))
            os.replace(part, self._folder / FILE)
        except OSError as error:
            sentence = f"an order that was obeyed cannot be kept: {error}; it may stop the robot again once"
            self._notices.say("disk", sentence, self._clock())
