"""From what the orchestrator granted to an open session: topic tables of the hardware, or of the robot's graph."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import count

from skytether.api import rest
from skytether.bridge import Bridge, SessionSpec
from skytether.bridge.port import Port
from skytether.bridge.spec import parse_id, parse_key
from skytether.messages import Encoding, Message, Twist, type_hash
from skytether.wire.topic import Role

from ..control.service_manager import Terms
from ..graphs.graph_base import Graph
from ..offload.shared_topics import SharedTopics
from ..session.session import Endpoint, LiveSession
from ..session.topic_table import Offer, robot_table, spoken
from .config import Address, AgentConfig

MakeBridge = Callable[[SessionSpec, Port, Address, Address], Endpoint]
"""Session, port, address to bind, address of the service."""


@dataclass(frozen=True, slots=True)
class OpenSession:
    """A session that is open, the instance that it is of, and what that is held to."""

    session: LiveSession
    instance: rest.Instance
    terms: Terms
    shared: SharedTopics


class SessionOpener:
    """Opens the robot's end of one session after the other.

    Args:
        config: What to do.
        topics: Message classes of the hardware's readings, by topic.
        graph: The robot's graph, if it has one.
        make_bridge: Makes the robot's end of the bridge; a real one if not given.
    """

    def __init__(
        self,
        config: AgentConfig,
        topics: Mapping[str, type[Message]],
        graph: Graph | None,
        make_bridge: MakeBridge | None = None,
    ) -> None:
        self._config = config
        self._topics = topics
        self._graph = graph
        self._epochs = count(1)
        self._make_bridge = make_bridge or (
            lambda spec, port, bind, peer: Bridge(spec, port, bind=bind, peer=peer, paths=config.paths)
        )

    def open(self, granted: rest.Session, peer: Address) -> LiveSession:
        """Open the robot's end of a session; it drives nothing until the control loop is given it.

        Args:
            granted: What the orchestrator says of it, with its key.
            peer: The service's address.

        Raises:
            BridgeError: The bridge cannot be had.
            ValueError: Something of another type is to drive, or the key is none.
        """
        for topic in granted.topics:
            if (topic.name, topic.direction) == (self._config.command_topic, "out") and topic.type != Twist.TYPE:
                # Bytes of another type may well decode: a Wrench has the shape of a Twist.
                raise ValueError(f"the service's {topic.name} is a {topic.type}, and only a {Twist.TYPE} may drive")
        command = self._config.command_topic
        shared = SharedTopics.of(granted.topics)
        if self._graph is None:
            readings = _offers({**self._topics, **shared.readings})
            topics = robot_table(spoken(granted.topics, None), readings)
            names = frozenset(topic.name for topic in topics)
            session = LiveSession(granted.id, names, command, self._epochs, shared_topic=shared.said)
        else:
            encoding = self._graph.encoding
            topics, port = self._graph.open([topic for topic in granted.topics if not topic.shared], command)
            between = [topic for topic in granted.topics if topic.shared]
            topics += robot_table(between, _offers(shared.readings, encoding), encoding=encoding)
            session = LiveSession(
                granted.id,
                frozenset(shared.readings),
                command,
                self._epochs,
                encoding=encoding,
                graph=port,
                shared_topic=shared.said,
            )
        spec = SessionSpec(parse_id(granted.id), parse_key(granted.key or ""), Role.ROBOT, topics)
        session.open(lambda port: self._make_bridge(spec, port, self._config.bind, peer), peer)
        return session


def _offers(topics: Mapping[str, type[Message]], encoding: Encoding = "cdr") -> dict[str, Offer]:
    """What a robot with these message classes can send."""
    return {name: Offer(cls.TYPE, type_hash(cls, encoding), encoding) for name, cls in topics.items()}
