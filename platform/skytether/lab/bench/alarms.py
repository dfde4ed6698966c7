"""How often a robot is driven by nobody for no reason: hand-overs under a link that is never cut, beside busy programs.

The same real processes as in `failover`, left alone. Each hand-over is a needless stop, and so is each stall of the
robot's own control loop.
"""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass

import numpy as np

from skytether.lab.granted import Granted
from skytether.robot.agent.agent import Agent
from skytether.robot.control.arbiter import Reason
from skytether.robot.control.command import Command, Source
from skytether.robot.control.control_status import ControlStatus

from .failover import LEARN_S, Wheels, bench_config, start_link, start_service, wait_for

_MOST_GAPS = 1_000_000
"""An hour at 200 Hz, and some."""
_LOOK_S = 0.5


@dataclass(frozen=True, slots=True)
class AlarmRow:
    """One line of the table.

    Attributes:
        rate_hz: Of the service's commands.
        seconds: How long the robot was watched, after 8 s in which it learned.
        busy: Programs that took a processor each meanwhile.
        commands: That arrived.
        hand_overs: Times that the robot's own controller took over, though nothing was cut.
        stalls: Times that the robot's control loop stood still for more than `VelocityLimits.watchdog_s`.
        gap_p99_ms: 99th percentile of the time between two commands.
        gap_max_ms: The longest.
        limit_ms: The silence that would have been too long, at the end.
    """

    rate_hz: float
    seconds: float
    busy: int
    commands: int
    hand_overs: int
    stalls: int
    gap_p99_ms: float
    gap_max_ms: float
    limit_ms: float

    def document(self) -> dict[str, object]:
        """For ``--json``."""
        return asdict(self)


def bench_alarms(
    rates_hz: Sequence[float], seconds: float, busy: int, on_look: Callable[[float, float, int], None]
) -> list[AlarmRow]:
    """Watch a robot that is driven at each rate.

    Args:
        rates_hz: Of the service's commands, above 1 Hz.
        seconds: For each rate.
        busy: Programs that take a processor each.
        on_look: Told the rate, the seconds that are over and the hand-overs until then.

    Raises:
        BenchError: The service did not drive in time.
        ValueError: A rate is out of its range.
    """
    for rate in rates_hz:
        if not 1 < rate <= 1000:
            raise ValueError(f"rate: must be above 1 and at most 1000 Hz, not {rate:g}")
    with ExitStack() as stack:
        for _ in range(busy):
            process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            stack.callback(process.wait)
            stack.callback(process.kill)
        return [_watch(rate, seconds, busy, on_look) for rate in rates_hz]


def _lost(status: ControlStatus) -> int:
    """Times that the cloud was left."""
    return sum(n for reason, n in status.transition_counts.items() if reason not in (Reason.START, Reason.RECOVERED))


class _Arrivals:
    def __init__(self) -> None:
        self.gaps: list[float] = []
        self._last: float | None = None

    def see(self, command: Command, _objection: object) -> None:
        """A command came."""
        if self._last is not None and len(self.gaps) < _MOST_GAPS:
            self.gaps.append(command.received_at - self._last)
        self._last = command.received_at


def _watch(rate: float, seconds: float, busy: int, on_look: Callable[[float, float, int], None]) -> AlarmRow:
    arrivals, wheels, never = _Arrivals(), Wheels(), threading.Event()
    with ExitStack() as stack:
        session, at = start_service(stack, rate)
        _, address = start_link(stack, at)
        placed = session.model_copy(update={"host": address[0], "port": address[1]})
        agent = stack.enter_context(Agent(bench_config(rate), wheels, client=Granted(placed), observer=arrivals.see))
        wait_for(lambda: agent.source is Source.CLOUD, agent, "the service does not drive")
        time.sleep(LEARN_S)
        arrivals.gaps.clear()
        before = agent.status().driver
        begin = time.monotonic()
        while (over := time.monotonic() - begin) < seconds:
            never.wait(min(_LOOK_S, seconds - over))
            on_look(rate, over, _lost(agent.status().driver) - _lost(before))
        after = agent.status().driver
    gaps = 1000 * np.asarray(arrivals.gaps or [float("inf")])
    return AlarmRow(
        rate_hz=rate,
        seconds=seconds,
        busy=busy,
        commands=len(arrivals.gaps),
        hand_overs=_lost(after) - _lost(before),
        stalls=after.stalls - before.stalls,
        gap_p99_ms=round(float(np.percentile(gaps, 99)), 1),
        gap_max_ms=round(float(gaps.max()), 1),
        limit_ms=round(1000 * after.silence_limit_s, 1),
    )
