"""The ends that ``skytether bridge`` runs in its process: graphs, bridges, synthetic sources, an emulated link."""

from __future__ import annotations

import heapq
import logging
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from skytether.api.config_file import ConfigError
from skytether.api.manifest import TopicSpec
from skytether.bridge.endpoint import Bridge
from skytether.bridge.interfaces import LocalPath, Wanted
from skytether.bridge.local import GraphPort, LocalGraph
from skytether.bridge.port import Port
from skytether.bridge.spec import SessionSpec, parse_id, topics_from_api
from skytether.emulator.udp_link import LinkConditions, LinkEmulator
from skytether.robot.session.topic_table import spoken
from skytether.ros import notes
from skytether.ros.names import Names
from skytether.ros.ros1.node import Node, NodeError
from skytether.ros.ros1.port import Ros1Port
from skytether.ros.ros2.config import join_graph
from skytether.ros.ros2.port import Ros2Port
from skytether.ros.translate import Translated
from skytether.wire import Config
from skytether.wire.events import Connected, Event, Refused
from skytether.wire.topic import Role, Topic

from .config import BridgeConfig, LinkConfig, Source

if TYPE_CHECKING:
    from skytether.ros.ros2.seam import GraphNode

_log = logging.getLogger(__name__)


class End:
    """One end: a graph, its bridge, and what became of the session.

    Attributes:
        was_connected: A session came up at some time.
        refusal: Why the peer's topic table cannot be joined; empty if it can.
        leave: Leaves the graph of ROS, if there is one; once the bridge has ended.
    """

    def __init__(
        self,
        settings: BridgeConfig,
        key: bytes,
        role: Role,
        peer: tuple[str, int] | None,
        node: Node | GraphNode | None = None,
    ) -> None:
        """Prepare; a node is the graph of ROS at this end.

        Raises:
            ValueError: A topic cannot be.
        """
        topics = topics_from_api(_carried(settings))
        self.role = role
        self.graph = LocalGraph()
        self.was_connected = False
        self.refusal = ""
        # Of two ends in one process the service's has the port that the configuration names.
        bind = (settings.bind.host, settings.bind.port if role.value in (settings.role, "service") else 0)
        config = Config() if settings.rate_mbps is None else Config(rate_bps=settings.rate_mbps * 1e6)
        port: Port
        self.leave: Callable[[], object] = lambda: None
        if node is None:
            port = GraphPort(self.graph, topics, role, on_event=self._on_event)
        elif isinstance(node, Node):
            if role is Role.ROBOT:  # whose bytes are what both ends agree on
                topics = tuple(replace(topic, encoding="ros1") for topic in topics)
            topics = (*topics, *notes.topics())
            port = _ros1_port(node, settings, topics, role, self._on_event)
            self.leave = port.close
        else:
            port = _ros2_port(node, settings, topics, role, self._on_event)
            self.leave = port.close
        if role is Role.SERVICE and node is not None:
            port = Translated(port, "ros1" if isinstance(node, Node) else "cdr", topics)
        spec = SessionSpec(parse_id(settings.id), key, role, topics)
        paths = local_paths(settings) if role is Role.ROBOT else ()
        self.bridge = Bridge(spec, port, bind=bind, peer=peer, paths=paths, config=config)
        sent = {t.name for t in topics if t.direction.sender is role}
        self.sources = tuple(s for s in settings.sources if s.topic in sent)

    def _on_event(self, event: Event) -> None:
        if isinstance(event, Connected):
            self.was_connected, self.refusal = True, ""
        elif isinstance(event, Refused):
            self.refusal = event.reason


class Sources:
    """Publishes made-up messages at their rates, in one thread, until closed."""

    def __init__(self, graph: LocalGraph, sources: Sequence[Source]) -> None:
        self._graph = graph
        self._sources = sources
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sources", daemon=True)

    def __enter__(self) -> Sources:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        payloads = [bytes(s.size) for s in self._sources]
        start = time.monotonic()
        due = [(start, i) for i in range(len(payloads))]
        while due:
            at, i = due[0]
            if self._closing.wait(max(0.0, at - time.monotonic())):
                return
            self._graph.publish(self._sources[i].topic, payloads[i])
            heapq.heapreplace(due, (at + 1 / self._sources[i].rate_hz, i))


def _carried(settings: BridgeConfig) -> Sequence[TopicSpec]:
    """Rows that this end can carry: a graph has no actions of the other generation of ROS, which is told."""
    if settings.ros1 is None and settings.ros2 is None:
        return settings.topics
    carried = spoken(settings.topics, "action" if settings.ros1 is not None else "ros2_action")
    for spec in settings.topics:
        if spec not in carried:
            _log.warning(
                "%s: an action of the other generation of ROS (kind: %s) is left out: actions are not turned into"
                " each other", spec.name, spec.kind,
            )  # fmt: skip
    return carried


def _ros1_port(
    node: Node, settings: BridgeConfig, topics: Sequence[Topic], role: Role, on_event: Callable[[Event], object]
) -> Ros1Port:
    """The ROS 1 graph of this end.

    Raises:
        ValueError: A topic cannot be in it.
    """
    assert settings.ros1 is not None  # noqa: S101 - the caller has a node of it
    home = settings.ros1.namespace
    names = Names(settings.topics, home, home, settings.ros1.remap)
    _check_used(names, "ros1")
    return Ros1Port(node, role, names, topics, on_event=on_event)


def _ros2_port(
    node: GraphNode, settings: BridgeConfig, topics: Sequence[Topic], role: Role, on_event: Callable[[Event], object]
) -> Ros2Port:
    """The ROS 2 graph of this end.

    Raises:
        ValueError: A topic cannot be in it.
    """
    assert settings.ros2 is not None  # noqa: S101 - the caller has a node of it
    home = settings.ros2.namespace
    names = Names(settings.topics, home, home, settings.ros2.remap, ros=2)
    _check_used(names, "ros2")
    return Ros2Port(node, topics, role, name_of=names.of, on_event=on_event)


def _check_used(names: Names, key: str) -> None:
    for unused in names.unused():
        raise ValueError(f"{key}.remap.{unused}: there is no such topic or call")


def _join(settings: BridgeConfig, folder: Path, stack: ExitStack) -> Node | GraphNode | None:
    """The node of the graph at this end.

    Raises:
        ConfigError: It cannot be joined as it is configured.
    """
    if settings.ros1 is not None:
        try:
            return stack.enter_context(Node(settings.ros1.node, settings.ros1.master, host=settings.ros1.host))
        except NodeError as error:
            raise ConfigError(f"ros1: {error}") from error
    if settings.ros2 is not None:
        return stack.enter_context(join_graph(settings.ros2, folder, settings.ros2.namespace))
    return None


def start_ends(settings: BridgeConfig, key: bytes, stack: ExitStack, folder: Path) -> list[End]:
    """Start what the configuration names; the stack ends it again.

    Args:
        settings: What to start.
        key: The session's.
        stack: Ends what is started.
        folder: That the configuration's paths are relative to.

    Raises:
        BridgeError: A port is taken, or an address cannot be used.
        ConfigError: A graph cannot be joined as it is configured.
        ValueError: A topic cannot be.
    """
    node = _join(settings, folder, stack)
    peer = (settings.peer.host, settings.peer.port) if settings.peer else None
    ends: list[End] = []
    for role in settings.roles:
        if ends:  # the robot of two ends in one process
            peer = ends[0].bridge.address
            if settings.link is not None:
                up, down = conditions(settings.link.up), conditions(settings.link.down)
                peer = stack.enter_context(LinkEmulator(peer, up=up, down=down)).address
        end = End(settings, key, role, peer, node)
        stack.callback(end.leave)
        stack.enter_context(end.bridge)
        stack.enter_context(Sources(end.graph, end.sources))
        ends.append(end)
    return ends


def local_paths(settings: BridgeConfig) -> Wanted:
    """Networks of the configuration as the bridge takes them."""
    if settings.paths == "auto":
        return "auto"
    return [LocalPath(p.local, p.cost, (p.peer.host, p.peer.port) if p.peer else None) for p in settings.paths]


def conditions(link: LinkConfig) -> LinkConditions:
    """Units of the configuration to those of the emulator.

    Raises:
        ValueError: The values exclude each other.
    """
    return LinkConditions(
        delay=link.delay_ms / 1000,
        jitter=link.jitter_ms / 1000,
        loss=link.loss,
        burst=link.burst,
        rate=None if link.rate_mbps is None else link.rate_mbps * 1e6,
        seed=link.seed,
    )
