"""What one topic of a session asks of the bridge: the row of the topic table."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

ANY = "*"
"""Name and type of a service's row that takes every topic the robot offers."""
MAX_PRIORITY = 127
COMPRESSIONS = ("", "zstd")


class Role(StrEnum):
    """Which end of the session an endpoint is. The robot speaks first (bridge rule 1)."""

    ROBOT = "robot"
    SERVICE = "service"


class Direction(StrEnum):
    """Which way a topic flows, as the service sees it (and as its manifest says)."""

    IN = "in"  # robot -> service
    OUT = "out"  # service -> robot

    @property
    def sender(self) -> Role:
        """The end that publishes this topic."""
        return Role.ROBOT if self is Direction.IN else Role.SERVICE


class PathUse(StrEnum):
    """How a topic uses a session's paths where there are several (rule 8)."""

    FAILOVER = "failover"
    """One path; both while that is in doubt or being left."""
    REDUNDANT = "redundant"
    """Every message by two paths: losing one of them loses nothing."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic and its quality of service.

    Attributes:
        name: Topic name, unique in its session.
        type: ROS 2 style type name, ``geometry_msgs/msg/Twist``; opaque to the bridge.
        direction: Which end sends.
        type_hash: ROS 1 MD5 or ROS 2 RIHS; two non-empty hashes must be equal. Empty: not checked.
        encoding: ``cdr`` (ROS 2) or ``ros1``; the robot's choice, opaque to the bridge.
        priority: 0 to 127, higher first, strict between shards (rule 4).
        period: Expected seconds between messages; None if irregular. Only for jitter.
        lifespan: Seconds a message may wait in the sender's queue, and again in the receiver's
            reassembly, before it is dropped. Time on the path does not count: a slow path is the
            robot's decision (age at the supervisor), not a reason to lose what has arrived.
        depth: Messages that may wait at the sender. 1 means newest value: a new message replaces a
            waiting one, and at the receiver an older message after a newer one is superseded.
            More than 1: every message is delivered, in order of arrival.
        delivery: Share of messages that should arrive, in (0, 1); sets the redundancy (rule 5).
        paths: Whether each message goes by two paths where there are several.
        reliable: Send until the peer has it (rule 7): every message once and in order. ``lifespan`` is then the time
            after which the sender gives up, and ``depth`` bounds the messages not yet acknowledged: with 1 a new
            message replaces the one that waits behind the one under way; with more, one too many is refused.
        latched: A reliable topic whose newest message is kept (it does not expire) and sent to every newcomer, also
            when it was published before there was a session.
        compression: ``zstd``, or empty for none. Messages that it does not make smaller travel as they are.
    """

    name: str
    type: str
    direction: Direction
    type_hash: str = ""
    encoding: str = "cdr"
    priority: int = 64
    period: float | None = None
    lifespan: float = 0.1
    depth: int = 1
    delivery: float = 0.99
    paths: PathUse = PathUse.FAILOVER
    reliable: bool = False
    latched: bool = False
    compression: str = ""

    def __post_init__(self) -> None:
        """Refuse what no endpoint could honour.

        Raises:
            ValueError: A field is out of its range; the text names the field and the range.
        """
        if not self.name or len(self.name) > 255:
            raise ValueError("topic: name must have 1 to 255 characters")
        if not 0 <= self.priority <= MAX_PRIORITY:
            raise ValueError(f"topic {self.name}: priority must be 0 to {MAX_PRIORITY}, not {self.priority}")
        if self.period is not None and not 0 < self.period < 3600:
            raise ValueError(f"topic {self.name}: period must be above 0 and below 3600 s, not {self.period}")
        if not 0 < self.lifespan <= 3600:
            raise ValueError(f"topic {self.name}: lifespan must be above 0 and at most 3600 s, not {self.lifespan}")
        if not 1 <= self.depth <= 10_000:
            raise ValueError(f"topic {self.name}: depth must be 1 to 10000, not {self.depth}")
        if not 0 < self.delivery < 1:
            raise ValueError(f"topic {self.name}: delivery must be between 0 and 1, not {self.delivery}")
        if self.latched and not self.reliable:
            raise ValueError(f"topic {self.name}: latched needs reliable")
        if self.compression not in COMPRESSIONS:
            raise ValueError(f"topic {self.name}: compression must be 'zstd' or empty, not '{self.compression}'")
