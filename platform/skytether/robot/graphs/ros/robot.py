"""A robot that is a graph of ROS, as far as both generations do it alike."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

from skytether.api.manifest import ANY_TOPIC, TopicSpec
from skytether.messages import Encoding, hash_of
from skytether.ros import permissions
from skytether.ros.names import Names, resolve
from skytether.ros.permissions import Permissions

from ...session.topic_table import Offer
from ..graph_config import RobotGraphConfig
from ..wheels_watch import NOBODY, Others, WheelsWatch

_log = logging.getLogger(__name__)


class _Closes(Protocol):
    def close(self) -> None: ...


class RosRobot(ABC):
    """What a service is offered, who else tells the wheels, and how the graph is left.

    Args:
        config: What is where.
    """

    encoding: Encoding

    def __init__(self, config: RobotGraphConfig) -> None:
        self._config = config
        self._port: _Closes | None = None
        """Of the session."""
        self._watch: WheelsWatch | None = None
        self._ends: list[Callable[[], None]] = []
        """What ends the robot's own topics, in the order in which they are ended."""

    @property
    def others(self) -> Others:
        """WatchesWheels: who else publishes what the wheels listen to."""
        return self._watch.others if self._watch is not None else NOBODY

    def close(self) -> None:
        """Leave the graph; the node stays."""
        if self._watch is not None:
            self._watch.close()
        if self._port is not None:
            self._port.close()
        for end in self._ends:
            end()

    @abstractmethod
    def _types(self, names: Sequence[str]) -> dict[str, str]:
        """Of topics, by their names in the graph; `ANY` where nobody publishes it yet."""

    def _checked(
        self, specs: Sequence[TopicSpec], command_topic: str, remapped: Iterable[str]
    ) -> tuple[Names, Permissions]:
        """Names of a service's topics in the graph, and what the service may do there.

        Args:
            specs: Those that the graph can speak.
            command_topic: That the agent keeps for itself.
            remapped: What else the robot's remappings are for.

        Raises:
            ValueError: A topic cannot be in this graph.
        """
        names = self._config.names(specs)
        may = self._config.permissions()
        permissions.check(may, specs, names, command_topic)
        for unused in names.unused(remapped):
            _log.warning("remap.%s has no effect: the service has no such topic", unused)
        return names, may

    def _offers(self, specs: Sequence[TopicSpec]) -> dict[str, Offer]:
        rows = [row for spec in specs for part in spec.parts() if part.kind != "call" for row in part.rows()]
        taken = {row.name: row.type for row in rows if row.direction == "in" and row.name != ANY_TOPIC}
        if any(row.name == ANY_TOPIC for row in rows):
            if not self._config.topics:
                _log.warning("the service takes any topic; name those that it is to get as topics: [...] in robot.yaml")
            wanted = (resolve(name, self._config.home) for name in self._config.topics)
            # One that nobody publishes yet is waited for: its type is told to the service when it comes (`ros.notes`).
            taken.update(self._types([name for name in wanted if name not in taken]))
        return {name: Offer(kind, hash_of(kind, self.encoding), self.encoding) for name, kind in taken.items()}
