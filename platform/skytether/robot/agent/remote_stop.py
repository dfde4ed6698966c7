"""Stop from afar, one way: orders of the orchestrator to stop are obeyed, once each. Nothing here can reset.

Only where the robot's own configuration says so (``safety.stop_from_afar``). An orchestrator that is away, or has no
order, changes nothing. An order that was obeyed is remembered over restarts of the agent, so that it does not stop the
robot again after a person has reset it.
"""

from __future__ import annotations

import json
import logging
import os
import stat
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from skytether.api.client import ApiError, Unreachable
from skytether.api.rest import StopOrder
from skytether.guard.estop import clean
from skytether.robot.log_throttle import LogThrottle

from ..safety.client import GateError, ask, stop

_log = logging.getLogger(__name__)

PERIOD_S = 2.0
"""Between two looks: half a request a second for each robot. An order is obeyed within that time and one request."""
FILE = "afar.json"
"""In the gate's folder: ids of orders that were obeyed."""
_REMEMBERED = 64
"""Orders; an orchestrator gives a robot one at a time."""
_LARGEST = 64 * 1024
"""Bytes of the file: as many ids as are remembered, and more."""


class Orders(Protocol):
    """What this needs of `skytether.api.client.Client`; every call raises ApiError or Unreachable."""

    def stop_order(self, name: str) -> StopOrder | None:
        """The last order."""
        ...

    def acknowledge_stop(self, name: str, order: str) -> StopOrder:
        """The robot stands."""
        ...


class RemoteStop:
    """Looks for orders, obeys and acknowledges them. For a thread of its own.

    Args:
        client: The orchestrator.
        robot: Its name.
        folder: The gate's.
        stop: Stops the robot; raises GateError if nobody took it.
        status: Of the gate, and under ``guard`` of the guard; raises GateError.
        clock: Monotonic seconds.
    """

    def __init__(
        self,
        client: Orders,
        robot: str,
        folder: Path,
        *,
        stop: Callable[[Path, str], dict[str, Any]] = stop,
        status: Callable[[Path], dict[str, Any]] = lambda folder: ask(folder, {"do": "status"}),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._client = client
        self._robot = robot
        self._folder = folder
        self._stop = stop
        self._status = status
        self._clock = clock
        self._log_throttle = LogThrottle(_log)
        self._obeyed = self._read()
        self._unkept = ""
        """An order that was obeyed, but is on no disk yet."""
        self._guard: object = None
        """Process of the guard that obeyed it: what another one says is no reset."""

    def step(self) -> None:
        """Look once."""
        try:
            order = self._client.stop_order(self._robot)
            if order is None or order.acknowledged_at is not None or order.robot != self._robot:
                return
            if order.id not in self._obeyed:
                if not (self._kept(order) if order.id == self._unkept else self._obey(order)):
                    return
                self._remember(order)
            self._client.acknowledge_stop(self._robot, order.id)
        except (ApiError, Unreachable) as error:
            self._log_throttle.warn("orders", f"orders to stop cannot be heard of: {error}", self._clock())

    def run(self, ended: threading.Event) -> None:
        """Look until told to end."""
        while not ended.wait(PERIOD_S):
            try:
                self.step()
            except Exception as error:  # one strange answer must not be the last one that is read
                self._log_throttle.warn("strange", f"an order to stop could not be read: {error!r}", self._clock())

    def _obey(self, order: StopOrder) -> bool:
        """Whether the robot is stopped, and that is on a disk."""
        try:
            answer = self._stop(self._folder, _reason(order))
        except GateError as error:
            self._log_throttle.warn("gate", f"an order to stop could not be obeyed: {error}", self._clock())
            return False
        _log.warning("%s", _reason(order))
        self._unkept = order.id if "note" in answer else ""
        if self._unkept:
            self._guard = self._of_guard().get("pid")
        return not self._unkept

    def _remember(self, order: StopOrder) -> None:
        """Not sooner than it is kept: else the next start of the agent would acknowledge what is kept nowhere."""
        self._unkept = ""
        self._obeyed = [*self._obeyed, order.id][-_REMEMBERED:]
        self._write()

    def _kept(self, order: StopOrder) -> bool:
        """Whether the stop is on a disk by now, or over: a person has reset the robot. Else it is asked for again."""
        guard = self._of_guard()
        same = bool(guard) and guard.get("pid") == self._guard
        if same and (guard.get("kept") or not guard.get("stopped")):
            return True
        kept = self._obey(order)
        if self._unkept:
            sentence = "a stop from afar is in effect, but could not be kept: it is not acknowledged yet"
            self._log_throttle.warn("kept", sentence, self._clock())
        return kept

    def _of_guard(self) -> dict[str, Any]:
        """What the guard says of itself, for the gate would only say what it heard of it last; empty: nothing."""
        try:
            return self._status(self._folder).get("guard") or {}
        except GateError as error:
            self._log_throttle.warn("gate", f"whether an order to stop was kept is not known: {error}", self._clock())
            return {}

    def _read(self) -> list[str]:
        """Nothing, if it is not a file of this user: a pipe would never end, and another user's ids are not ours."""
        try:
            file = os.open(self._folder / FILE, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOFOLLOW)
            with open(file, "rb") as opened:
                about = os.fstat(file)
                if not stat.S_ISREG(about.st_mode) or about.st_uid != os.geteuid():
                    return []
                found = json.loads(opened.read(_LARGEST))
        except (OSError, ValueError, RecursionError):
            return []
        return [str(one) for one in found][-_REMEMBERED:] if isinstance(found, list) else []

    def _write(self) -> None:
        part = self._folder / (FILE + ".new")
        try:
            part.unlink(missing_ok=True)  # whatever is there, a link to another file say
            with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600), "w") as opened:
                opened.write(json.dumps(self._obeyed))
            os.replace(part, self._folder / FILE)
        except OSError as error:
            sentence = f"an order that was obeyed cannot be kept: {error}; it may stop the robot again once"
            self._log_throttle.warn("disk", sentence, self._clock())


def _reason(order: StopOrder) -> str:
    """On one line, and short: it goes to logs and terminals."""
    return clean(f"stopped from afar by {order.by}: {order.reason}")
