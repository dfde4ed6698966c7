"""The program on the robot: asks for a service, runs its end of the bridge, drives (Mello, thesis, figure 18(a)).

Three threads that never wait for each other: the control loop at a fixed rate with absolute deadlines, the lease client
that speaks REST, and a watch on the bridge's counters. The bridge has its own, and so has the log. What is decided is
decided in `control_loop`.
"""

from __future__ import annotations

import logging
import threading
import time
import uuid
from collections.abc import Callable, Mapping
from functools import partial
from math import nan
from random import Random
from types import TracebackType
from typing import Any

from skytether.api import rest
from skytether.api.client import Client
from skytether.bridge import BridgeError
from skytether.messages import Twist, warm
from skytether.wire.stats import SessionStats

from ..control import fallback
from ..control.command import Source
from ..control.control_loop import Clocks, ControlLoop, Observer, RobotHardware
from ..control.service_manager import ServiceManager, terms
from ..graphs.graph_base import Graph, TellsTopics
from ..graphs.wheels_watch import NOBODY, WatchesWheels
from ..log_throttle import LogThrottle
from ..offload.lease_client import InstanceReported, LeaseClient, MoveFailed, Orchestrator, Wanted
from ..offload.resolver import Resolver
from ..offload.shared_topics import Serving, SharedTopics, SharedTopicsExchange
from ..offload.site_prober import SiteProber
from ..offload.task_manager import PathQuality, RobotView
from ..session.counter_totals import CounterTotals
from ..session.link_quality import Quality
from ..session.rates import Rates
from ..session.session import LiveSession
from .clocks import read_clocks
from .config import AgentConfig
from .gate_report import GateReporter
from .gate_watch import GateWatch
from .log_queue import log_queue
from .remote_stop import RemoteStop
from .session_opener import MakeBridge, OpenSession, SessionOpener
from .snapshot import AgentStatus, report
from .status import StatusServer, document, metrics

_log = logging.getLogger(__name__)

_LARGEST_ANSWER = 1 << 20
"""Bytes of an answer of the orchestrator: a session of a thousand topics is less, and the control loop waits for no
reader of more."""
_WATCH_S = 0.1
"""Between looks at the bridge's counters."""
_JOIN_S = 2.0
"""A thread that does not end by then is left behind; the wheels have been stopped before."""


class Agent:
    """Drives one robot. A context manager: entering starts it, leaving stops wheels, threads, bridge and instance.

    Args:
        config: What to do.
        hardware: The robot's hardware.
        graph: The robot's graph, if it has one: what the service takes in and gives out then goes by it as bytes, all
            but the command topic.
        observer: Told each command from the cloud; must return at once.
        client: The orchestrator; made from the configuration if not given.
        bridge: Makes the robot's end of the bridge.
        clock: Monotonic seconds; the bridge's must be the same.
        clocks: The same clock, and one that goes on while the computer sleeps; without it `read_clocks`, or with a
            ``clock`` that is made up, that one alone.
        random: For the jitter of the back-off.

    Raises:
        FallbackError: The fallback cannot be had.
    """

    def __init__(
        self,
        config: AgentConfig,
        hardware: RobotHardware,
        *,
        graph: Graph | None = None,
        observer: Observer | None = None,
        client: Orchestrator | None = None,
        bridge: MakeBridge | None = None,
        clock: Callable[[], float] = time.monotonic,
        clocks: Clocks | None = None,
        random: Random | None = None,
    ) -> None:
        self._config = config
        self._hardware = hardware
        self._graph = graph
        self._clock = clock
        self._clocks = clocks or (read_clocks if clock is time.monotonic else lambda: (self._clock(), None))
        self._opener = SessionOpener(config, hardware.topics, graph, bridge)
        local = fallback.load(config.fallback, config.fallback_options)
        self._control_loop = ControlLoop(hardware, local, config.limits, config.needs, clock(), observer, self._clocks)
        self._own_client = (
            None
            if client
            else Client(
                config.url,
                config.token,
                timeout=config.request_timeout_s,
                ca_file=config.ca_file,
                insecure_http=config.insecure_http,
                largest=_LARGEST_ANSWER,
            )
        )
        speaks: Any = client or self._own_client
        self._site_prober = (
            None
            if config.task is None
            else SiteProber(config.task, speaks, config.service, drives=local.drives, clock=clock)
        )
        self._lease_client = LeaseClient(
            speaks,
            report=self.report,
            another_token=self._another_token,
            clock=clock,
            renew_s=config.renew_s,
            random=random,
        )
        self._gate = None if config.gate is None else GateWatch(config.gate)
        self._gate_reporter = (
            None
            if self._gate is None
            else GateReporter(speaks, config.robot, self._gate.last, on_refused=self._another_token, clock=clock)
        )
        self._remote_stop = (
            RemoteStop(speaks, config.robot, config.gate, clock=clock)
            if config.gate is not None and config.stop_from_afar
            else None
        )
        self._sharing = SharedTopicsExchange(speaks, self._shares, on_refused=self._another_token, clock=clock)
        self._token = config.token
        self._instance: rest.Instance | None = None
        self._manager: ServiceManager | None = None
        self._open_sessions: dict[str, OpenSession] = {}
        """By session id."""
        self._served = ""
        """The session that the manager watches."""
        self._left = ""
        """The one before; its instance may still be told of."""
        self._log_throttle = LogThrottle(_log)
        self._resolver = Resolver()
        self._stats: SessionStats | None = None
        self._rates = Rates()
        self._totals = CounterTotals(uuid.uuid4().hex)
        self._trouble = ""
        self._asked_at: float | None = None
        self._overruns = 0
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []
        self._server: StatusServer | None = None
        self._logs = False

    def start(self) -> None:
        """Start driving and asking; returns at once. Until `close` no line of the log is waited for (`log_queue`)."""
        if not self._logs:
            self._logs = True
            log_queue.use()
        warm([*self._hardware.topics.values(), Twist], self._graph.encoding if self._graph else "cdr")
        self._asked_at = self._clock()
        self._serve()
        targets: dict[str, Callable[[], object]] = {
            "control": self._control,
            "ask": partial(self._lease_client.run, self._stop, self.ask),
            "watch": self._watch,
            "share": partial(self._sharing.run, self._stop),
            **({"decide": partial(self._site_prober.run, self._stop)} if self._site_prober else {}),
            **({"gate": partial(self._gate.run, self._stop)} if self._gate else {}),
            **({"say_gate": partial(self._gate_reporter.run, self._stop)} if self._gate_reporter else {}),
            **({"afar": partial(self._remote_stop.run, self._stop)} if self._remote_stop else {}),
        }
        for name, target in targets.items():
            thread = threading.Thread(target=target, name=f"agent_{name}", daemon=True)
            thread.start()
            self._threads.append(thread)

    def close(self) -> None:
        """Stop the wheels first, then the rest; the instance is let go."""
        self._stop.set()
        for thread in self._threads:
            thread.join(_JOIN_S + self._config.request_timeout_s * (thread.name == "agent_ask"))
            if thread.is_alive():
                _log.error("thread %s does not end; going on without it", thread.name)
        self._threads.clear()
        self._control_loop.halt()
        if self._server is not None:
            self._server.close()
            self._server = None
        self._drop_sessions()
        self._lease_client.release()
        if self._own_client is not None:
            self._own_client.close()
        if self._logs:
            self._logs = False
            log_queue.done()

    @property
    def status_port(self) -> int | None:
        """Where ``/status`` and ``/metrics`` are on loopback; None: nowhere."""
        return self._server.port if self._server else None

    def _serve(self) -> None:
        config = self._config
        if config.status_port is None:
            return
        try:
            self._server = StatusServer(
                config.status_port,
                lambda: document(config.robot, config.service, self.status(), self._clock()),
                lambda: metrics(config.robot, config.service, self.status(), self.report()),
            )
        except OSError as error:  # somebody else has the port; that is no reason not to drive
            _log.error("no status on port %d of loopback: %s", config.status_port, error.strerror)
            return
        if config.status_port not in (0, self._server.port):
            _log.warning(
                "port %d of loopback is taken, so the status of robot %s is on port %d: skytether robot status %s",
                config.status_port,
                config.robot,
                self._server.port,
                config.robot,
            )

    def tick(self, now: float, boot: float | None = None) -> None:
        """One turn of the control loop; called by its thread, or by a test with made-up time."""
        self._control_loop.tick(now, boot)

    @property
    def source(self) -> Source:
        """Who drives now; from any thread."""
        return self._control_loop.source

    def status(self) -> AgentStatus:
        """What is known now; from any thread."""
        session = self._control_loop.session
        return AgentStatus(
            driver=self._control_loop.status(),
            instance=self._instance,
            trouble=self._lease_client.trouble or self._trouble or (session.refused if session else ""),
            asked_at=self._asked_at,
            connected=session is not None and session.connected,
            session=self._stats,
            rtt=self._control_loop.quality.rtt,
            loss=self._control_loop.quality.loss,
            overruns=self._overruns,
            log_lines_dropped=log_queue.dropped,
            gate=self._gate.report if self._gate else None,
            late=self._control_loop.quality.late,
            decision=self._site_prober.decision if self._site_prober else None,
            load=self._site_prober.robot.load if self._site_prober else nan,
            battery=self._site_prober.robot.battery if self._site_prober else None,
            others=self._graph.others if isinstance(self._graph, WatchesWheels) else NOBODY,
            topics=tuple(self._graph.topics()) if isinstance(self._graph, TellsTopics) else (),
            rates=self._rates.now,
        )

    def report(self) -> rest.Report:
        """What the orchestrator is told with each renewal."""
        robot = self._site_prober.robot if self._site_prober else RobotView()
        return report(
            self._control_loop.status(),
            self._totals,
            self._stats,
            self._control_loop.quality.rtt,
            load=robot.load,
            battery=robot.battery,
            overruns=self._overruns,
            gate=self._gate.report if self._gate else None,
        )

    def _control(self) -> None:
        period = 1 / self._config.rate_hz
        deadline = self._clock()
        try:
            while not self._stop.is_set():
                self.tick(*self._clocks())
                deadline += period
                late = self._clock() - deadline
                if late < 0:
                    self._stop.wait(-late)
                elif late > period:
                    self._overruns += 1
                    deadline += late  # ticks that were missed are not made up for
        finally:
            self._control_loop.halt()

    def ask(self) -> float:
        """One exchange with the orchestrator and what follows from it; called by its thread, or by a test.

        Returns:
            Seconds until the next is due.
        """
        wanted = self._wanted()
        if wanted.request is None:
            self._drop_sessions()
            self._instance = None
        delay = self._lease_client.step(wanted)
        while (event := self._lease_client.next_event()) is not None:
            match event:
                case InstanceReported(instance):
                    self._follow(instance)
                case MoveFailed(kept, reason):
                    self._stay(kept, reason)
        return delay

    def _request(self, measured: Mapping[str, rest.Measurement]) -> rest.InstanceCreate:
        config = self._config
        return rest.InstanceCreate(
            robot=config.robot,
            service=config.service,
            params=dict(config.params),
            measurements={**config.measurements, **measured},
            lease_s=config.lease_s,
        )

    def _wanted(self) -> Wanted:
        """What is asked for now; no request: nothing, the robot's own controller drives."""
        session = self._control_loop.session
        opened = self._open_sessions.get(session.id) if session is not None else None
        serving = opened.instance.id if opened is not None else None
        healthy = self._control_loop.source is Source.CLOUD
        if self._site_prober is None:
            return Wanted(self._request({}), None, serving, healthy)
        decision = self._site_prober.decision
        request = self._request(self._site_prober.measurements()) if decision.offload else None
        return Wanted(request, decision.site, serving, healthy)

    def _drop_sessions(self) -> None:
        self._control_loop.let_go()
        opened, self._open_sessions = list(self._open_sessions.values()), {}
        for one in opened:
            self._end(one.session)

    def _end(self, session: LiveSession) -> None:
        session.close()
        if session.bridge is not None:
            self._totals.update(session, session.bridge.stats(), last=True)

    def _stay(self, instance: rest.Instance, reason: str) -> None:
        """What was to take over does not."""
        serving = self._control_loop.session
        if self._graph is not None and len(self._open_sessions) > 1:
            # The graph's topics went to the session that is given up: the one that serves is joined anew.
            self._drop_sessions()
            self._served = ""
            serving = None
        if serving is not None:
            self._control_loop.let_go()
            self._control_loop.session = serving
        for session_id in [i for i in self._open_sessions if serving is None or i != serving.id]:
            self._end(self._open_sessions.pop(session_id).session)
        if self._site_prober is not None:
            self._site_prober.stayed(instance, reason)

    def _another_token(self) -> bool:
        """Look for a newer token where this one came from; True if there is one."""
        if self._config.fresh_token is None or self._own_client is None:
            return False
        try:
            token = self._config.fresh_token()
        except Exception as error:  # a file that is being written, or gone
            self._log_throttle.warn("token", f"no newer token: {error}", self._clock())
            return False
        known, self._token = self._token, token
        if token != known:
            self._own_client.set_token(token)
        return token != known

    def _watch(self) -> None:
        while not self._stop.wait(_WATCH_S):
            self.watch(self._clock())

    def watch(self, now: float) -> None:
        """Look at the bridge's counters once."""
        self._settle()
        for opened in list(self._open_sessions.values()):
            if opened.session.bridge is not None:
                self._totals.update(opened.session, opened.session.bridge.stats())
        session = self._control_loop.session
        if session is None or session.bridge is None:
            return
        self._stats = session.bridge.stats()
        self._rates.sample(self._stats, now)
        if self._manager is not None:
            self._control_loop.quality = self._manager.watch(self._stats, now)
            if self._site_prober is not None:
                found = self._control_loop.quality
                known = session.connected
                self._site_prober.live(PathQuality(found.rtt, nan, found.loss) if known else PathQuality())
            for kind, sentence in self._manager.troubles():
                self._log_throttle.warn(kind, sentence, now)

    def _follow(self, instance: rest.Instance) -> None:
        """The orchestrator said something about an instance: open a session to it, or follow the service's address.

        Another instance comes beside the one that drives, and takes over with its first command (`ControlLoop.offer`).
        """
        granted = instance.session
        opened = self._open_sessions.get(granted.id) if granted else None
        if opened is None or granted is None or granted.id == self._served:
            self._told(instance)
        if (
            granted is None
            or granted.key is None
            or granted.host is None
            or granted.port is None
            or granted.id == self._left
        ):
            return
        peer = self._config.route(granted.host, granted.port)
        try:
            peer = self._resolver.address(*peer)
            if opened is not None:
                opened.session.move(peer)
                return
            session = self._opener.open(granted, peer)
        except (BridgeError, ValueError) as error:
            sentence = f"no bridge to {peer[0]}:{peer[1]}: {error}"
            if sentence != self._trouble:
                _log.error("%s", sentence)
                self._trouble = sentence
            return
        self._trouble = ""
        held_to = terms(granted.needs, granted.topics, self._config.command_topic)
        self._open_sessions[granted.id] = OpenSession(session, instance, held_to, SharedTopics.of(granted.topics))
        self._control_loop.offer(session)

    def _told(self, instance: rest.Instance) -> None:
        self._instance = instance
        if self._site_prober is not None:
            self._site_prober.placed(instance)

    def _settle(self) -> None:
        """Hold the service that serves now to its terms, once it has changed, and close what was left."""
        session = self._control_loop.session
        opened = self._open_sessions.get(session.id) if session else None
        if opened is not None and session is not None and session.id != self._served:
            self._left, self._served = self._served, session.id
            self._told(opened.instance)
            self._manager = ServiceManager(opened.terms, self._config.command_topic, self._config.limits.silence_s)
            self._control_loop.quality = Quality()
            self._control_loop.hold_to(opened.terms)
        while self._control_loop.left:
            left = self._control_loop.left.popleft()
            self._open_sessions.pop(left.id, None)
            self._end(left)

    def _shares(self) -> Serving | None:
        """What serves the robot now, for sharing."""
        session = self._control_loop.session
        opened = self._open_sessions.get(session.id) if session is not None else None
        return None if opened is None else Serving(opened.session, opened.instance.id, opened.shared)

    def __enter__(self) -> Agent:
        try:
            self.start()
        except BaseException:  # a signal, too: what has begun to drive must stop before its graph is left
            self.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
