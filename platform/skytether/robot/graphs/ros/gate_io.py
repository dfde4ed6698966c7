"""The gate's way to hardware in a graph of ROS, as far as both generations do it alike."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable
from typing import Generic, Protocol, TypeVar

from skytether.control.admittance import Velocity
from skytether.messages import Message, Twist, Vector3

from ..inbox import Inbox
from ..wheels_watch import NOBODY, Others, WheelsWatch

_log = logging.getLogger(__name__)


class _Closes(Protocol):
    def close(self) -> None: ...


Node = TypeVar("Node", bound=_Closes)


def twist_of(velocity: Velocity) -> Twist:
    """What the wheels' topic carries."""
    return Twist(linear=Vector3(x=velocity.linear), angular=Vector3(z=velocity.angular))


def not_acknowledged(topic: str, names: Iterable[str]) -> str:
    """What is said of those who listen to the wheels' topic and do not acknowledge it."""
    return f"{topic} is not acknowledged by {' or '.join(sorted({*names}))}; they are braked until it is"


class RosGateNode(Generic[Node]):
    """A node of the gate's own.

    Args:
        node: Started.
    """

    def __init__(self, node: Node) -> None:
        self._node = node

    def close(self) -> None:
        """Leave the graph."""
        self._node.close()


class RosWheels(RosGateNode[Node]):
    """What is the same of every `skytether.robot.graphs.gate_io.Wheels` in a graph of ROS."""

    _watch: WheelsWatch | None = None
    """Of the gate, which looks who else publishes the topic."""
    _missed = False

    def _look_for(self, awaited: Collection[str], there: Collection[str], topic: str) -> None:
        """Tell once that those who turn the wheels do not listen, though others do.

        Args:
            awaited: Full names of their nodes; empty: it may be anybody.
            there: Of those who listen.
            topic: The wheels'.
        """
        missed = bool(awaited and there) and not {*awaited} & {*there}
        if missed and not self._missed:
            others = ", ".join(sorted({name or "a node without a name" for name in there}))
            _log.warning(
                "%s: none of wheels_nodes (%s) listens, only %s; the wheels are told nothing until one does",
                topic,
                ", ".join(awaited),
                others,
            )
        self._missed = missed

    def full(self) -> bool:
        """Wheels: never; what nobody takes in time is thrown away."""
        return False

    @property
    def others(self) -> Others:
        """WatchesWheels: who else publishes the topic; the gate's own looks for that."""
        return self._watch.others if self._watch is not None else NOBODY

    def close(self) -> None:
        """Leave the graph."""
        if self._watch is not None:
            self._watch.close()
        super().close()


class RosSensors(RosGateNode[Node]):
    """A `skytether.robot.graphs.gate_io.Sensors` over what the node's threads put into an inbox.

    Args:
        node: Started.
        inbox: Of the topics.
    """

    def __init__(self, node: Node, inbox: Inbox) -> None:
        super().__init__(node)
        self._inbox = inbox

    def stops(self) -> Iterable[tuple[str, Message]]:
        """Sensors: what stops the robot."""
        return self._inbox.drain_stops()

    def read(self) -> Iterable[tuple[str, Message]]:
        """Sensors: what else came since the last turn."""
        return self._inbox.drain()
