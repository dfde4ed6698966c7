"""When a service steps: at absolute times or on a message, until told to stop or left alone too long."""

from __future__ import annotations

import math
from typing import Any

from .clock import Clock
from .errors import ServiceError
from .port import ServicePort
from .service import Service
from .step_times import StepTimes


class Loop:
    """Runs the steps of one service in the thread that calls `run`.

    Args:
        service: Not started yet.
        port: Its port; tells whether a robot is connected.
        clock: Where time comes from.
        idle_exit: End after so many seconds without a robot.
        times: Where it is noted how long each step takes; None: nowhere.
    """

    def __init__(
        self,
        service: Service[Any],
        port: ServicePort,
        clock: Clock,
        idle_exit: float,
        times: StepTimes | None = None,
    ) -> None:
        self.steps = 0
        self.skipped = 0
        """Steps left out because an earlier one, or the machine, was late by a whole period."""
        self._service = service
        self._port = port
        self._clock = clock
        self._idle_exit = idle_exit
        self._times = times
        self._stopping = False
        self._step_began: float | None = None

    def in_step_for(self) -> float:
        """Seconds that the present step has taken; 0 between steps. From any thread."""
        began = self._step_began
        return 0.0 if began is None else self._clock.now() - began

    def stop(self) -> None:
        """End after the current step; from any thread or signal handler."""
        self._stopping = True
        self._clock.wake()

    def run(self) -> None:
        """Step until stopped or idle. The service is started already; whatever its step raises comes out of here.

        Raises:
            ServiceError: The service sets neither a rate nor a trigger, or both, or a rate that is none.
        """
        rate, trigger = self._service.rate_hz, self._service.trigger
        if (rate is None) == (trigger is None):
            raise ServiceError(f"{type(self._service).__name__} must set either rate_hz or trigger")
        if trigger is not None:
            self._on_message(trigger)
        elif rate is not None and 0 < rate < math.inf:
            self._at_rate(1 / rate)
        else:
            raise ServiceError(f"{type(self._service).__name__}: rate_hz must be above 0, not {rate}")
        if self.skipped:
            self._service.log.warning("%d steps done, %d skipped", self.steps, self.skipped)

    def _at_rate(self, period: float) -> None:
        begin = idle_since = self._clock.now()
        index = 0
        while not self._stopping:
            self._answer()
            now = self._clock.now()
            due = begin + index * period
            if now < due:
                self._clock.sleep_until(min(due, self._port.due()))
                continue
            missed = int((now - due) / period)
            if missed:
                self._count_skipped(missed, period)
            index += missed + 1
            self._step(now)
            if self._port.connected:
                idle_since = now
            elif self._idle(now, idle_since):
                return

    def _on_message(self, topic: str) -> None:
        mailbox = self._service.mailboxes[topic]
        stepped = None
        idle_since = self._clock.now()
        while not self._stopping:
            self._answer()
            now = self._clock.now()
            newest = mailbox.latest
            if newest is not stepped:
                stepped = newest
                self._step(now)
            elif self._port.connected:
                self._clock.sleep_until(self._port.due())
                idle_since = self._clock.now()
            elif self._idle(now, idle_since):
                return
            else:
                self._clock.sleep_until(idle_since + self._idle_exit)

    def _answer(self) -> None:
        """What the robot asked since the last look."""
        self._port.settle(self._clock.now())
        self._port.desk.work()

    def _step(self, now: float) -> None:
        self._step_began = now
        self._port.settle(now)
        self._service.step(now)
        self._step_began = None
        if self._times is not None:
            ended = self._clock.now()
            self._times.note(ended, ended - now)
        self.steps += 1

    def _idle(self, now: float, since: float) -> bool:
        if now - since < self._idle_exit:
            return False
        self._service.log.info("no robot for %g s: ending", self._idle_exit)
        return True

    def _count_skipped(self, missed: int, period: float) -> None:
        if not self.skipped:
            self._service.log.warning(
                "late by %d steps of %g ms, skipped them; more of these are counted, not logged", missed, period * 1e3
            )
        self.skipped += missed
