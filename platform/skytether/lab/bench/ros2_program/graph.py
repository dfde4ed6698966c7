"""What both kinds of graph have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field

Deliver = Callable[[int, "bytes | memoryview", int], None]
"""Called with a flow's index, a serialised message and where its payload begins, from any thread."""

HEAD = bytes((0, 1, 0, 0)) + bytes(8)
"""std_msgs/msg/UInt8MultiArray in CDR as far as the length of its data: little-endian, no dimensions, offset 0."""
HEAD_BYTES = len(HEAD) + 4


def serialise(payload: bytes) -> bytes:
    """A std_msgs/msg/UInt8MultiArray with this payload."""
    return b"".join((HEAD, len(payload).to_bytes(4, "little"), payload))


@dataclass(frozen=True)
class Flow:
    """One topic, as the harness describes it; with a type where messages are made and decoded."""

    size: int
    hz: float
    topic: str = ""
    depth: int = 10
    type: str = ""


@dataclass(frozen=True)
class Wanted:
    """What an end is told first.

    Attributes:
        kind: ``rclpy``, ``cyclonedds``, or ``typed`` for rclpy with messages that are made and decoded.
        domain: ROS_DOMAIN_ID.
        reliable: Else best effort.
        flows: Of both directions.
        sends: Indices of those that this end sends.
        receives: And receives.
    """

    kind: str
    domain: int
    reliable: bool
    flows: list[Flow] = field(default_factory=list)
    sends: list[int] = field(default_factory=list)
    receives: list[int] = field(default_factory=list)


class Graph(ABC):
    """One end's node."""

    @abstractmethod
    def connected(self) -> bool:
        """Whether each topic has its other end."""

    @abstractmethod
    def publish(self, index: int, payload: bytes) -> None:
        """Send one message."""

    @abstractmethod
    def close(self) -> None:
        """Leave."""
