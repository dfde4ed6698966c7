"""What a session tells its owner. Each event is small, frozen, and final."""

from __future__ import annotations

from dataclasses import dataclass

from .topic import Topic


@dataclass(frozen=True, slots=True)
class Connected:
    """The handshake is done and confirmed; messages flow. Comes again after a peer's restart."""

    topics: tuple[Topic, ...]
    """The agreed topic table: the robot's names, types and encodings, the service's quality of service."""
    restarted: bool = False
    """Whether this is another peer than before: it knows nothing of what the one before was told."""


@dataclass(frozen=True, slots=True)
class Disconnected:
    """The peer was silent for too long, or said goodbye. The robot's end keeps trying by itself."""

    reason: str
    """Bounded: ``silent``, ``goodbye`` or ``closed``."""


@dataclass(frozen=True, slots=True)
class MessageReceived:
    """One authenticated, complete, unexpired message."""

    topic: str
    payload: bytes | memoryview
    """Read-only; a view into memory of its own for large messages."""
    sequence: int
    """Per topic and handshake (of a reliable topic: per life of the sender), from 0, without gaps at the sender."""
    sent_at: float
    """When the peer's application published it, in this end's monotonic seconds; see ``sent_at_error``.
    ``received_at`` while the clock offset is unknown."""
    sent_at_error: float
    """Bound of the clock offset's error in seconds (half the best round trip seen); inf before the first."""
    received_at: float
    """When the last shard needed arrived, in this end's monotonic seconds."""


@dataclass(frozen=True, slots=True)
class PeerMoved:
    """Authenticated packets now come from another address; answers follow it (rule 2)."""

    address: object


@dataclass(frozen=True, slots=True)
class PathSwitched:
    """This end sends by another path from now on (rule 8)."""

    path: int
    reason: str
    """Bounded: ``lost``, ``closed``, ``cheaper`` or ``better``."""


@dataclass(frozen=True, slots=True)
class Refused:
    """The peer proved it knows the key but its topic table cannot be joined with ours."""

    reason: str
    """One sentence naming the topic and both values."""


Event = Connected | Disconnected | MessageReceived | PathSwitched | PeerMoved | Refused
