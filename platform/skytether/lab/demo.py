"""The main job, end to end: a simulated smart walker asks for ``virtual-trail`` and is guided by it.

Everything between is real: an orchestrator process, a service process, sockets, the agent with its supervisor. Only the
walker, the person who pushes it and the network in between are simulated. One control period of the robot is one step
of the simulation, in real time.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from math import isnan
from pathlib import Path

from skytether.api.client import Client
from skytether.api.rest import RobotCreate
from skytether.emulator.udp_link import LinkConditions, LinkEmulator
from skytether.messages import JointState, Message, Odometry, Twist, WrenchStamped
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig
from skytether.robot.agent.snapshot import AgentStatus
from skytether.robot.control.command import Source
from skytether.wire.stats import TopicStats

from .embedded import EmbeddedOrchestrator
from .measures import Judge, Measures, Sample
from .plot import plot_walk
from .trail import Trail
from .walk import STEP, World

ROBOT = "walker"
SERVICE = "virtual-trail"

_CATCH_UP = 20
"""Steps that the simulation makes at most at once after the control loop was held up: more would be a jump."""
_LOOK_S = 0.05
"""Between looks at the walk."""
_SETTLE_S = 1.0
"""After the walk, beyond the round trip: time for the last messages and reports to arrive."""


class DemoError(Exception):
    """The walk could not begin; the text says why, in one sentence."""


@dataclass(frozen=True, slots=True)
class DemoSettings:
    """What to show.

    Attributes:
        rtt_s: Round trip of the emulated network [s].
        jitter_s: Standard deviation of the one-way delay [s].
        loss: Share of packets lost in each direction, 0 to 1.
        burst: Mean length of a run of lost packets; None: each packet is lost by itself.
        seed: Of the person, the sensors' noise and the network.
        output: Folder for the plot; made if missing.
        state_dir: Of the orchestrator; None: a temporary one.
        start_limit_s: The service must drive by then [s].
        walk_limit_s: The trail must be walked by then [s].
    """

    rtt_s: float = 0.1
    jitter_s: float = 0.0
    loss: float = 0.01
    burst: float | None = None
    seed: int = 1
    output: Path = Path("demo-output")
    state_dir: Path | None = None
    start_limit_s: float = 20.0
    walk_limit_s: float = 180.0

    def link(self, direction: int) -> LinkConditions:
        """One direction of the network, 0 or 1; the two have different chances."""
        return LinkConditions(
            delay=self.rtt_s / 2, jitter=self.jitter_s, loss=self.loss, burst=self.burst, seed=2 * self.seed + direction
        )


@dataclass(frozen=True, slots=True)
class DemoResult:
    """What came out.

    Attributes:
        measures: Of the walk, from the first command of the service.
        start_s: From the request to the arrival of the service's first valid command [s].
        status: The agent's snapshot at the end of the walk, with the bridge's counters after it had settled.
        plot: The picture.
    """

    measures: Measures
    start_s: float
    status: AgentStatus
    plot: Path

    @property
    def rtt_s(self) -> float:
        """Median round trip of the path as the bridge measured it [s]."""
        paths = self.status.session.paths if self.status.session else ()
        return paths[0].rtt_p50 if paths else float("nan")

    @property
    def fallback_s(self) -> float:
        """Time under local control during the walk [s]."""
        return self.measures.source_s[Source.FALLBACK]

    @property
    def topics(self) -> tuple[TopicStats, ...]:
        """Quality of service of each topic."""
        return self.status.session.topics if self.status.session else ()

    def document(self) -> dict[str, object]:
        """For programs: the keys of ``skytether demo --json``."""
        walk = self.measures
        return {
            "completed": walk.completed,
            "time_s": _round(walk.time_s),
            "mean_speed_m_s": _round(walk.mean_speed_m_s, 4),
            "kte_m": _round(walk.kte_m, 4),
            "start_s": _round(self.start_s),
            "rtt_ms": _round(self.rtt_s * 1000),
            "fallback_s": _round(self.fallback_s),
            "topics": {
                topic.topic: {
                    "refused": topic.refused,
                    "dropped": topic.dropped,
                    "sent": topic.sent,
                    "delivered": topic.delivered,
                    "superseded": topic.superseded,
                    "lost": topic.lost,
                    "unsettled": topic.unsettled,
                    "delay_p50_ms": _round(topic.delay_p50 * 1000),
                    "delay_p99_ms": _round(topic.delay_p99 * 1000),
                    "jitter_ms": _round(topic.jitter * 1000),
                }
                for topic in self.topics
            },
            "plot": str(self.plot),
        }


class WalkerHardware:
    """The simulated walker as the agent's hardware. The person begins to walk when the service drives."""

    topics: Mapping[str, type[Message]] = {"force": WrenchStamped, "wheels": JointState, "odom": Odometry}

    def __init__(self, world: World) -> None:
        self.world = world
        self.samples: list[Sample] = []
        """The walk so far: time, true position, who drives."""
        self.source: Callable[[], Source] = lambda: Source.STOP
        """Who drives now; given by the owner once there is an agent."""
        self.walking = threading.Event()
        self.ended = threading.Event()
        """Set by the owner: the walker has been parked and measures nothing more."""
        self._command = Twist()
        self._began: float | None = None
        self._steps = 0

    def read(self, now: float) -> Iterable[tuple[str, Message]]:
        """Advance the simulation to now."""
        if self.ended.is_set():
            return ()
        if self._began is None:
            self._began = now
        due = round((now - self._began) / STEP) + 1  # rounded, so that a tick that is a little off is still one step
        if due - self._steps > _CATCH_UP:
            self._steps = due - _CATCH_UP
        messages: list[tuple[str, Message]] = []
        while self._steps < due:
            self._steps += 1
            source = self.source()
            if source is Source.CLOUD:
                self.walking.set()
            sensors = self.world.step(now, self._command, walking=self.walking.is_set())
            messages += sensors.messages()
            if self.walking.is_set():
                pose = self.world.pose
                self.samples.append(Sample(self.world.elapsed, pose.x, pose.y, source))
        return messages

    def write(self, twist: Twist) -> None:
        """Take the velocity for the next step."""
        self._command = twist


@dataclass(slots=True)
class Demo:
    """One run. A context manager: entering starts orchestrator, network and agent; leaving ends them in reverse order.

    Its parts are attributes, so that an experiment can meddle with them while it runs.
    """

    settings: DemoSettings
    trail: Trail = field(default_factory=Trail)
    orchestrator: EmbeddedOrchestrator = field(init=False)
    network: LinkEmulator = field(init=False)
    base: WalkerHardware = field(init=False)
    agent: Agent = field(init=False)
    _stack: ExitStack = field(default_factory=ExitStack)

    def __enter__(self) -> Demo:
        settings = self.settings
        with ExitStack() as stack:
            self.orchestrator = stack.enter_context(EmbeddedOrchestrator(settings.state_dir))
            with Client(self.orchestrator.url, self.orchestrator.operator_token) as operator:
                token = operator.create_robot(RobotCreate(name=ROBOT, services=(SERVICE,))).token
            self.network = stack.enter_context(
                LinkEmulator(("127.0.0.1", 9), up=settings.link(0), down=settings.link(1))
            )
            self.base = WalkerHardware(World(self.trail, seed=settings.seed))
            config = AgentConfig(
                robot=ROBOT,
                url=self.orchestrator.url,
                token=token,
                service=SERVICE,
                fallback="admittance",
                bind=("127.0.0.1", 0),
                route=self._through_network,
            )
            self.agent = Agent(config, self.base)
            self.base.source = lambda: self.agent.source
            stack.enter_context(self.agent)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def walk(self, on_progress: Callable[[float, AgentStatus], None] = lambda *_: None) -> DemoResult:
        """Wait for the walk to end.

        Args:
            on_progress: Told the arc length reached [m] and the agent's status, some twenty times a second.

        Raises:
            DemoError: The service did not take over in time.
        """
        self._wait_for_start()
        judge, seen = Judge(self.trail), 0
        deadline = time.monotonic() + self.settings.walk_limit_s
        while not judge.completed and time.monotonic() < deadline:
            samples = self.base.samples
            for sample in samples[seen:]:
                judge.add(sample)
            seen = len(samples)
            on_progress(judge.s, self.agent.status())
            time.sleep(_LOOK_S)
        walk = self.agent.status()
        self.base.ended.set()
        self._settle()
        return self._result(judge.result(), walk)

    def _settle(self) -> None:
        """Wait until both ends agree on what was sent and what arrived."""
        deadline = time.monotonic() + self.settings.rtt_s + _SETTLE_S
        while time.monotonic() < deadline:
            session = self.agent.status().session
            # Each end counts its own part at once and learns of the other's later: arrivals here, or departures there.
            if session and all(
                topic.sent == topic.delivered + topic.superseded + topic.lost for topic in session.topics
            ):
                return
            time.sleep(_LOOK_S)

    def _wait_for_start(self) -> None:
        limit = self.settings.start_limit_s
        if self.base.walking.wait(limit):
            return
        trouble = self.agent.status().trouble or "its commands do not arrive; the link is worse than the service bears"
        raise DemoError(f"the service did not drive the walker within {limit:.0f} s: {trouble}")

    def _through_network(self, host: str, port: int) -> tuple[str, int]:
        self.network.set_target(host, port)
        return self.network.address

    def _result(self, measures: Measures, walk: AgentStatus) -> DemoResult:
        status = replace(walk, session=self.agent.status().session)
        first, asked = status.driver.first_command_at, status.asked_at
        start_s = first - asked if first is not None and asked is not None else float("nan")
        settings = self.settings
        settings.output.mkdir(parents=True, exist_ok=True)
        name = f"walk-{settings.rtt_s * 1000:.0f}ms-{settings.loss * 100:g}pct-seed{settings.seed}.png"
        plot = (settings.output / name).resolve()
        plot_walk(
            self.base.samples,
            self.trail,
            plot,
            title=f"virtual-trail over {settings.rtt_s * 1000:.0f} ms round trip and {settings.loss * 100:g} % loss",
            caption=(
                f"{measures.time_s:.1f} s, mean speed {measures.mean_speed_m_s:.3f} m/s, "
                f"kinematic tracking error {measures.kte_m * 1000:.0f} mm, "
                f"{measures.source_s[Source.FALLBACK]:.1f} s under local control"
            ),
        )
        return DemoResult(measures, start_s, status, plot)


def _round(value: float, digits: int = 3) -> float | None:
    """For JSON, which has no NaN."""
    return None if isnan(value) else round(value, digits)
