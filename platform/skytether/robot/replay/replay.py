"""Streams a recording to a service as a robot would: through orchestrator and bridge, at the recording's times.

The bytes are the recording's own. What the far end counted decides whether everything arrived.
"""

from __future__ import annotations

import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import nan
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from skytether.api import rest
from skytether.api.client import ApiError, Unreachable
from skytether.bridge import Bridge, BridgeError, SessionSpec
from skytether.bridge.port import Publisher
from skytether.bridge.spec import parse_id, parse_key
from skytether.ros import notes
from skytether.ros.notes import NOTES, Notes, TypeNote
from skytether.wire.events import Connected, Event, MessageReceived, Refused
from skytether.wire.stats import SessionStats, TopicStats
from skytether.wire.topic import Direction, Role, Topic

from ..agent.config import Address
from ..agent.snapshot import report
from ..offload.lease_client import InstanceReported, LeaseClient, Orchestrator, Wanted
from ..session.counter_totals import CounterTotals
from ..session.topic_table import robot_table
from .bag import Bag

_START_S = 30.0
"""For the service to come up."""
_CONNECT_S = 10.0
"""For the handshake."""
_STOP_S = 15.0
"""For the service to end, so that its recording is complete."""
_STALLED_S = 5.0
"""Without any progress at the far end, what is missing will not arrive any more."""
_POLL_S = 0.05


class ReplayError(Exception):
    """The replay cannot be done; one sentence that says why and what to do."""


@dataclass(frozen=True, slots=True)
class ReplayConfig:
    """What to stream where.

    Attributes:
        bag: ROS 1 bag, ROS 2 bag or MCAP file.
        robot: Name of the robot that is played.
        service: What takes the topics in.
        params: The service's.
        topics: Which ones, by their names in the recording; None: all that the service takes.
        remap: Names for the service, by those of the recording.
        speed: Times faster than it was recorded.
        bind: Local address of the robot's end of the bridge.
        route: Where to send what is meant for the service's address; for experiments with an emulated link.
    """

    bag: Path
    robot: str
    service: str = "recorder"
    params: Mapping[str, Any] = field(default_factory=dict)
    topics: tuple[str, ...] | None = None
    remap: Mapping[str, str] = field(default_factory=dict)
    speed: float = 1.0
    bind: Address = ("0.0.0.0", 0)  # noqa: S104 - see AgentConfig.bind
    route: Callable[[str, int], Address] = lambda host, port: (host, port)


@dataclass(frozen=True, slots=True)
class TopicResult:
    """What became of one topic.

    Attributes:
        topic: Its name.
        type: Its type's.
        messages: In the recording.
        refused: Not taken by the bridge, which had no session just then.
        dropped: Taken, but too old or too many before the network could have them.
        sent: Handed to the network. ``messages == refused + dropped + sent``.
        delivered: Given to the service.
        lost: Sent, and not delivered: whatever the reason. ``sent == delivered + lost``.
        delay_p50_s: One way, median [s]; NaN if not measured.
        delay_p99_s: One way [s].
    """

    topic: str
    type: str
    messages: int
    refused: int
    dropped: int
    sent: int
    delivered: int
    lost: int
    delay_p50_s: float
    delay_p99_s: float


@dataclass(frozen=True, slots=True)
class ReplayResult:
    """What became of the replay.

    Attributes:
        instance: The instance that took it in.
        seconds: From the first message to the last confirmation.
        topics: One each, in the recording's order.
    """

    instance: str
    seconds: float
    topics: tuple[TopicResult, ...]

    @property
    def complete(self) -> bool:
        """Every message of the recording was delivered."""
        return all(topic.delivered == topic.messages for topic in self.topics)


@dataclass(frozen=True, slots=True)
class Progress:
    """How far it is.

    Attributes:
        stage: ``starting``, ``streaming``, ``confirming`` or ``stopping``.
        sent: Messages so far.
        total: Messages in all.
        position: Seconds of the recording.
    """

    stage: str
    sent: int
    total: int
    position: float = 0.0


def replay(
    config: ReplayConfig, client: Orchestrator, progress: Callable[[Progress], None] = lambda _: None
) -> ReplayResult:
    """Stream a recording; the instance is ended in any case.

    Args:
        config: What to stream where.
        client: The orchestrator.
        progress: Told often.

    Raises:
        ReplayError: The service did not start or ended early, takes none of the topics, or no session came up.
        BagError: The recording cannot be read.
    """
    with Bag(config.bag) as bag:
        names = _chosen(config, bag)
        run = _Replay(config, client, bag, names, progress)
        try:
            run.start()
            return run.stream()
        finally:
            run.stop()


def _chosen(config: ReplayConfig, bag: Bag) -> frozenset[str]:
    if not config.speed > 0:
        raise ReplayError(f"the speed must be above 0, not {config.speed}")
    unknown = sorted({*(config.topics or ()), *config.remap} - set(bag.topics))
    if unknown:
        has = ", ".join(sorted(bag.topics)) or "none"
        raise ReplayError(f"{config.bag} has no topic {', '.join(unknown)}; it has {has}")
    names = frozenset(bag.topics if config.topics is None else config.topics)
    sent_as = Counter(config.remap.get(name, name) for name in names)
    twice = sorted(name for name, count in sent_as.items() if count > 1)
    if twice:
        raise ReplayError(f"two topics of {config.bag} would be sent as {twice[0]}; choose one with --topic")
    return names


class _Replay:
    """One replay: the instance, the robot's end of the bridge, and the counting. Also the bridge's port."""

    def __init__(
        self,
        config: ReplayConfig,
        client: Orchestrator,
        bag: Bag,
        names: frozenset[str],
        progress: Callable[[Progress], None],
    ) -> None:
        self._config = config
        self._client = client
        self._bag = bag
        self._names = names
        self._progress = progress
        self._instance: rest.Instance | None = None
        self._ended = ""
        self._totals = CounterTotals(uuid.uuid4().hex)
        self._bridge: Bridge | None = None
        self._peer: Address | None = None
        self._settled = threading.Event()
        self._refused = ""
        self._refused_messages: Counter[str] = Counter()
        self._stop = threading.Event()
        self._keeper: threading.Thread | None = None
        self._lease_client = LeaseClient(client, report=self._report)
        self._newest: rest.Instance | None = None
        """Told of last; whoever replays leaves the one before at once."""

    def start(self) -> None:
        """Ask for the service and wait for the session."""
        self._progress(Progress("starting", 0, 0))
        session = self._wait_until_running()
        table = self._table(session)
        peer = self._peer = self._config.route(session.host or "", session.port or 0)
        spec = SessionSpec(parse_id(session.id), parse_key(session.key or ""), Role.ROBOT, table)
        try:
            self._bridge = Bridge(spec, self, bind=self._config.bind, peer=peer)
            self._bridge.start()
        except BridgeError as error:
            raise ReplayError(str(error)) from error
        self._keeper = threading.Thread(
            target=self._lease_client.run, args=(self._stop, self._ask), name="replay-ask", daemon=True
        )
        self._keeper.start()
        if not self._settled.wait(_CONNECT_S):
            raise ReplayError(
                f"the service at {peer[0]}:{peer[1]} does not answer over UDP; is it reachable from here, "
                "and no firewall in between?"
            )
        if self._refused:
            raise ReplayError(f"the service refused the session: {self._refused}")

    def stream(self) -> ReplayResult:
        """Send everything at its time, and wait until the far end has counted it."""
        bridge = self._bridge
        if bridge is None:
            raise ReplayError("the replay was not started")
        total = sum(self._bag.topics[name].messages for name in self._names)
        types = {
            self._sent_as(name): TypeNote(topic.offer.type, topic.offer.type_hash, topic.definition)
            for name, topic in self._bag.topics.items()
            if name in self._names
        }
        bridge.publish(NOTES[Role.ROBOT], Notes(types).pack())
        begin = time.monotonic()
        sent = 0
        for at, topic, data in self._bag.messages(self._names):
            self._sleep_until(begin + at / self._config.speed)
            if not bridge.publish(self._sent_as(topic), data):
                self._refused_messages[topic] += 1  # no session for the moment
            sent += 1
            self._progress(Progress("streaming", sent, total, at))
        self._progress(Progress("confirming", sent, total, self._bag.duration))
        stats = self._confirm(bridge, total)
        return ReplayResult(
            instance=self._instance.id if self._instance else "",
            seconds=time.monotonic() - begin,
            topics=tuple(self._result(name, stats) for name in self._bag.topics if name in self._names),
        )

    def stop(self) -> None:
        """End bridge and instance, and wait for the service to end, so that what it writes is complete."""
        self._progress(Progress("stopping", 0, 0))
        self._stop.set()
        if self._keeper is not None:
            self._keeper.join()
        if self._bridge is not None:
            self._bridge.stop()
        instance = self._lease_client.release()
        if instance is None:
            return
        deadline = time.monotonic() + _STOP_S
        try:
            while not self._client.get_instance(instance).state.final and time.monotonic() < deadline:
                time.sleep(_POLL_S)
        except (ApiError, Unreachable):
            return  # forgotten already, or nobody to ask

    def attach(self, publisher: Publisher) -> None:
        """Port: nothing is needed from the bridge here."""

    def deliver(self, message: MessageReceived) -> None:
        """Port: what the service sends back is not looked at."""

    def notify(self, event: Event) -> None:
        """Port: know that the session is up, or never will be."""
        if isinstance(event, Refused):
            self._refused = event.reason
        if isinstance(event, Refused | Connected):
            self._settled.set()

    def _ask(self) -> float:
        """One exchange with the orchestrator; returns the seconds until the next is due."""
        serving = self._newest.id if self._newest is not None else None
        delay = self._lease_client.step(Wanted(_request(self._config), serving=serving))
        while (event := self._lease_client.next_event()) is not None:
            if isinstance(event, InstanceReported):
                self._newest = event.instance
                self._follow(event.instance)
        return delay

    def _follow(self, instance: rest.Instance) -> None:
        if self._instance is not None and instance.id != self._instance.id:
            self._ended = self._ended or f"instance {self._instance.id} ended before the replay did"
            return
        self._instance = instance
        session = instance.session
        if self._bridge is not None and session is not None and session.host and session.port:
            peer = self._config.route(session.host, session.port)
            if peer != self._peer:
                self._peer = peer
                self._bridge.set_peer(*peer)

    def _report(self) -> rest.Report | None:
        if self._bridge is None:
            return None
        stats = self._bridge.stats()
        self._totals.update(self._bridge, stats)
        return report(None, self._totals, stats, min((path.rtt for path in stats.paths), default=nan))

    def _wait_until_running(self) -> rest.Session:
        deadline = time.monotonic() + _START_S
        while True:
            delay = self._ask()
            if self._lease_client.trouble:
                raise ReplayError(self._lease_client.trouble)
            instance = self._instance
            if instance is not None and instance.state is rest.State.RUNNING:
                if instance.session is None:
                    raise ReplayError(
                        f"the token may not see the session of instance {instance.id}; use the token of robot "
                        f"'{self._config.robot}'"
                    )
                if instance.session.key and instance.session.host and instance.session.port:
                    return instance.session
                delay = _POLL_S
            if time.monotonic() > deadline:
                why = f": {instance.reason}" if instance and instance.reason else ""
                raise ReplayError(f"service '{self._config.service}' did not start within {_START_S:.0f} s{why}")
            time.sleep(delay)

    def _table(self, session: rest.Session) -> tuple[Topic, ...]:
        offers = {self._sent_as(name): self._bag.topics[name].offer for name in self._bag.topics if name in self._names}
        table = robot_table(session.topics, offers)
        agreed = {topic.name for topic in table if topic.direction is Direction.IN}
        taken = {name for name in self._names if self._sent_as(name) in agreed}
        if not taken or (self._config.topics is not None and taken != self._names):
            takes = ", ".join(topic.name for topic in session.topics if topic.direction == "in") or "none"
            raise ReplayError(
                f"service '{self._config.service}' does not take {', '.join(sorted(self._names - taken))}; "
                f"it takes {takes}; the recording's names are changed with --remap OLD:=NEW"
            )
        self._names = frozenset(taken)
        return (*table, *(row for row in notes.topics() if row.direction is Direction.IN))

    def _sleep_until(self, when: float) -> None:
        while (left := when - time.monotonic()) > 0:
            time.sleep(min(left, 0.5))
            if self._ended:
                raise ReplayError(self._ended)

    def _confirm(self, bridge: Bridge, total: int) -> SessionStats:
        best, since = -1, time.monotonic()
        ours = {self._sent_as(name) for name in self._names}
        while True:
            stats = bridge.stats()
            delivered = sum(topic.delivered for topic in stats.topics if topic.topic in ours)
            if delivered > best:
                best, since = delivered, time.monotonic()
            if delivered >= total or time.monotonic() - since > _STALLED_S:
                return stats
            time.sleep(_POLL_S)

    def _sent_as(self, name: str) -> str:
        """The service's name of a topic of the recording."""
        return self._config.remap.get(name, name)

    def _result(self, name: str, stats: SessionStats) -> TopicResult:
        counted = {topic.topic: topic for topic in stats.topics}
        topic = counted.get(self._sent_as(name)) or TopicStats(name, Direction.IN, 0)
        return TopicResult(
            topic=name,
            type=self._bag.topics[name].offer.type,
            messages=self._bag.topics[name].messages,
            refused=self._refused_messages[name],
            dropped=max(0, self._bag.topics[name].messages - self._refused_messages[name] - topic.sent),
            sent=topic.sent,
            delivered=topic.delivered,
            lost=topic.sent - topic.delivered,
            delay_p50_s=topic.delay_p50,
            delay_p99_s=topic.delay_p99,
        )


def _request(config: ReplayConfig) -> rest.InstanceCreate:
    try:
        return rest.InstanceCreate(robot=config.robot, service=config.service, params=dict(config.params))
    except ValidationError as error:
        first = error.errors()[0]
        raise ReplayError(f"{'.'.join(map(str, first['loc']))} '{first['input']}': {first['msg']}") from error
