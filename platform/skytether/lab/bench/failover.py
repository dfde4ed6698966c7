"""How long a robot is driven by nobody: from the moment a link is cut to the first velocity of its own controller.

Everything between is real: the agent with its control loop, bridge and supervisor in this process, the service's end of
the bridge in one of its own, the link that is cut in a third, sockets between them. The link is cut at a random moment
between two commands, and mended once the robot has driven itself for a while.
"""

from __future__ import annotations

import base64
import multiprocessing
import os
import random
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from itertools import pairwise
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import numpy as np

from skytether.api import rest
from skytether.api.manifest import Needs as ServiceNeeds
from skytether.api.manifest import TopicSpec
from skytether.bridge import Bridge, SessionSpec
from skytether.bridge.local import GraphPort, LocalGraph
from skytether.emulator.udp_link import LinkConditions, LinkEmulator
from skytether.lab.granted import Granted
from skytether.messages import Message, Twist, Vector3, Wrench, WrenchStamped, encode
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig
from skytether.robot.control.command import Command, Source
from skytether.robot.control.failure_detector import least_s
from skytether.robot.control.supervisor import VelocityLimits
from skytether.wire.topic import Role

from .pair import BenchError

Address = tuple[str, int]
RATES_HZ = (100.0, 50.0, 20.0, 10.0, 5.0)
LEARN_S = 8.0
"""The service's commands are listened to for this long, before the first cut."""
_SPEED = 0.2
"""What the service commands [m/s]."""
_PUSH = 12.0
"""What the person pushes with [N]: the robot's own controller, left alone, drives at 0.1 m/s."""
_LOCAL_S = 0.25
"""The robot drives itself for this long before the link is mended; much longer, and the bridge's session would end."""
_TICKS_MS = 20.0
"""Two ticks of the control loop: it looks, and it writes."""
_LIMIT_S = 30.0
_LOOK_S = 0.002


@dataclass(frozen=True, slots=True)
class FailoverRow:
    """One line of the table.

    Attributes:
        rate_hz: Of the service's commands.
        n: Cuts.
        cut_to_local_p50_ms: Median time from the cut to the first velocity of the robot's own controller.
        cut_to_local_p99_ms: 99th percentile (the largest, when there are fewer than 100).
        cut_to_local_max_ms: The largest.
        jitter_ms: The longest gap between two commands while nothing was cut, less their period.
        bound_ms: What it should stay under: three periods of the commands and 1.25 times the jitter, at least what is
            waited for a sender like clockwork (`least_s`), at most `most_s`; and two ticks of the control loop.
        velocity_jump_max_m_s: Largest change from one velocity that the wheels were told to the next, around the cuts.
    """

    rate_hz: float
    n: int
    cut_to_local_p50_ms: float
    cut_to_local_p99_ms: float
    cut_to_local_max_ms: float
    jitter_ms: float
    bound_ms: float
    velocity_jump_max_m_s: float

    def document(self) -> dict[str, object]:
        """For ``--json``."""
        return asdict(self)


class _Written(NamedTuple):
    at: float
    linear: float
    source: Source


class Wheels:
    """Wheels that remember what they were told, and a force sensor that feels a constant push."""

    topics: Mapping[str, type[Message]] = {"force": WrenchStamped}

    def __init__(self) -> None:
        self.written: deque[_Written] = deque(maxlen=1000)
        self.source: Callable[[], Source] = lambda: Source.STOP

    def read(self, _now: float) -> Iterable[tuple[str, Message]]:
        return [("force", WrenchStamped(wrench=Wrench(force=Vector3(x=_PUSH))))]

    def write(self, twist: Twist) -> None:
        self.written.append(_Written(time.monotonic(), twist.linear.x, self.source()))


def bench_failover(
    rates_hz: Sequence[float], n: int, seed: int = 1, on_cut: Callable[[float, int], None] = lambda *_: None
) -> list[FailoverRow]:
    """Cut the link ``n`` times for each rate.

    Args:
        rates_hz: Of the service's commands, above 1 Hz.
        n: Cuts at each rate.
        seed: Of the moments at which the link is cut.
        on_cut: Told the rate and how many cuts are done.

    Raises:
        BenchError: The service did not drive in time, or the robot did not help itself.
        ValueError: A rate is out of its range.
    """
    for rate in rates_hz:
        if not 1 < rate <= 1000:
            raise ValueError(f"rate: must be above 1 and at most 1000 Hz, not {rate:g}")
    chance = random.Random(seed)
    return [_measure(rate, n, chance, on_cut) for rate in rates_hz]


def _measure(rate: float, n: int, chance: random.Random, on_cut: Callable[[float, int], None]) -> FailoverRow:
    with ExitStack() as stack:
        session, at = start_service(stack, rate)
        link, address = start_link(stack, at)
        base = Wheels()
        placed = session.model_copy(update={"host": address[0], "port": address[1]})
        gaps = _Gaps()
        agent = stack.enter_context(Agent(bench_config(rate), base, client=Granted(placed), observer=gaps.see))
        base.source = lambda: agent.source
        times, jumps = [], []
        wait_for(lambda: agent.source is Source.CLOUD, agent, "the service does not drive")
        time.sleep(LEARN_S)
        for i in range(n):
            seconds, jump = _cut_once(agent, base, link, 1 / rate, chance, gaps)
            times.append(1000 * seconds)
            jumps.append(jump)
            on_cut(rate, i + 1)
    jitter = max(0.0, 1000 * (gaps.longest - 1 / rate))
    p50, p99 = np.percentile(times, [50, 99], method="inverted_cdf")
    return FailoverRow(
        rate_hz=rate,
        n=n,
        cut_to_local_p50_ms=round(float(p50), 1),
        cut_to_local_p99_ms=round(float(p99), 1),
        cut_to_local_max_ms=round(max(times), 1),
        jitter_ms=round(jitter, 1),
        bound_ms=round(
            min(max(3000 / rate + 1.25 * jitter, 1000 * least_s(1 / rate)), 1000 * most_s(rate)) + _TICKS_MS, 1
        ),
        velocity_jump_max_m_s=round(max(jumps), 4),
    )


def bench_config(rate: float) -> AgentConfig:
    """A robot that is driven so many times a second."""
    return AgentConfig(
        robot="bench",
        url="",
        token="",
        service="bench",
        fallback="admittance",
        limits=VelocityLimits(max_gap_s=most_s(rate)),
        bind=("127.0.0.1", 0),
    )


def start_service(stack: ExitStack, rate: float) -> tuple[rest.Session, Address]:
    """The service's end of a bridge in a process of its own, and where it listens."""
    session = _session(rate)
    return session, _child(stack, _run_service, session, rate)[1]


def start_link(stack: ExitStack, target: Address) -> tuple[Connection, Address]:
    """A link to there in a process of its own: True cuts it, False mends it; and where it listens."""
    return _child(stack, _run_link, target)


def most_s(rate: float) -> float:
    """The longest silence that the robot's limits bear: that of the fast ones, or four periods."""
    return max(0.4, 4 / rate)


class _Gaps:
    """The longest gap between commands while the link is not cut."""

    def __init__(self) -> None:
        self.longest = 0.0
        self._last: float | None = None

    def see(self, command: Command, _objection: object) -> None:
        """A command came."""
        if self._last is not None:
            self.longest = max(self.longest, command.received_at - self._last)
        self._last = command.received_at

    def pause(self) -> None:
        """The link is cut."""
        self._last = None


def _cut_once(
    agent: Agent, base: Wheels, link: Connection, period: float, chance: random.Random, gaps: _Gaps
) -> tuple[float, float]:
    """Time from the cut to the first local velocity [s], and the largest jump of the velocity around it [m/s]."""
    while True:
        wait_for(lambda: agent.source is Source.CLOUD, agent, "the service does not drive")
        wait_for(lambda: base.written[-1].linear == _SPEED, agent, "the service's velocity is not reached")
        time.sleep(0.2 + chance.uniform(0, period))
        if agent.source is Source.CLOUD:  # and not back with the robot, for a hiccup of this machine
            break
    base.written.clear()
    link.send(True)
    cut_at: float = link.recv()
    wait_for(lambda: agent.source is not Source.CLOUD, agent, "the robot does not help itself")
    time.sleep(_LOCAL_S)
    written = list(base.written)
    gaps.pause()
    link.send(False)
    link.recv()
    local = next(w for w in written if w.at >= cut_at and w.source is not Source.CLOUD)
    jumps = [abs(b.linear - a.linear) for a, b in pairwise(written)]
    return local.at - cut_at, max(jumps)


def wait_for(condition: Callable[[], bool], agent: Agent, trouble: str) -> None:
    """Wait until it is so.

    Raises:
        BenchError: It does not come to that.
    """
    deadline = time.monotonic() + _LIMIT_S
    while not condition():
        if time.monotonic() > deadline:
            said = agent.status()
            raise BenchError(f"{trouble} within {_LIMIT_S:.0f} s: {said.trouble or said.driver.why}")
        time.sleep(_LOOK_S)


def _session(rate: float) -> rest.Session:
    period = 1000 / rate
    topics = (
        TopicSpec(name="force", type=WrenchStamped.TYPE, direction="in", priority=100, period_ms=10, lifespan_ms=50),
        TopicSpec(name="cmd_vel", type=Twist.TYPE, direction="out", priority=127, period_ms=period, delivery=0.9999),
    )
    key = base64.b64encode(os.urandom(32)).decode()
    return rest.Session(id=os.urandom(8).hex(), key=key, topics=topics, needs=ServiceNeeds(max_rtt_ms=500))


def _child(stack: ExitStack, run: Callable[..., None], *arguments: Any) -> tuple[Connection, tuple[str, int]]:
    """A process of its own that tells an address, and ends when its pipe is closed."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=run, args=(theirs, *arguments), daemon=True)
    process.start()
    theirs.close()
    stack.callback(process.join, 5.0)
    stack.callback(ours.close)
    try:
        return ours, ours.recv()
    except EOFError as error:
        raise BenchError(f"a process of the measurement did not start: {run.__name__}") from error


def _run_service(pipe: Connection, session: rest.Session, rate: float) -> None:
    """The service's end: commands at a steady rate until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    spec = SessionSpec.from_api(Role.SERVICE, session.id, session.key or "", session.topics)
    ended = threading.Event()
    threading.Thread(target=_until_closed, args=(pipe, ended), daemon=True).start()
    with Bridge(spec, GraphPort(LocalGraph(), spec.topics, Role.SERVICE)) as bridge:
        pipe.send(bridge.address)
        due = time.monotonic()
        while not ended.wait(max(0.0, due - time.monotonic())):
            bridge.publish("cmd_vel", encode(Twist(linear=Vector3(x=_SPEED))))
            due += 1 / rate


def _until_closed(pipe: Connection, ended: threading.Event) -> None:
    with suppress(EOFError, OSError):
        pipe.recv()
    ended.set()


def _run_link(pipe: Connection, target: tuple[str, int]) -> None:
    """The link: cut or mended as it is told, and says when it was."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with LinkEmulator(target) as link, suppress(EOFError, OSError):
        pipe.send(link.address)
        while True:
            conditions = LinkConditions(cut=pipe.recv())
            link.set(up=conditions, down=conditions)
            pipe.send(time.monotonic())
