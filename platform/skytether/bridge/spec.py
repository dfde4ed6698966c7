"""What an end must know to hold its session, and how it comes out of the REST schemas. Names units once."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Iterable
from dataclasses import dataclass, field

from skytether.api.manifest import TopicSpec
from skytether.wire.topic import Direction, PathUse, Role, Topic

KEY_BYTES = 32


@dataclass(frozen=True, slots=True)
class SessionSpec:
    """One end's half of a session.

    Attributes:
        id: 64 bits, the same at both ends.
        key: 32 secret bytes, the same at both ends; never in a text form of this object.
        role: Which end this is.
        topics: This end's table; the ends agree on what both have.
    """

    id: int
    key: bytes = field(repr=False)
    role: Role
    topics: tuple[Topic, ...]

    def __post_init__(self) -> None:
        """Refuse what no session could use.

        Raises:
            ValueError: The text names the field and what it must be.
        """
        if not 0 <= self.id < 1 << 64:
            raise ValueError("session: id must be a number of 64 bits")
        if len(self.key) != KEY_BYTES:
            raise ValueError(f"session: key must have {KEY_BYTES} bytes, not {len(self.key)}")
        names = [t.name for t in self.topics]
        if len(set(names)) != len(names):
            twice = next(n for n in names if names.count(n) > 1)
            raise ValueError(f"session: topic '{twice}' is listed twice")

    @classmethod
    def from_api(cls, role: Role, session_id: str, key: str, topics: Iterable[TopicSpec]) -> SessionSpec:
        """Build from what a grant or an instance's session holds.

        Args:
            role: Which end this is.
            session_id: 16 hexadecimal digits.
            key: 32 bytes in base64.
            topics: The service's topics.

        Raises:
            ValueError: The text names the field and what it must be, and never holds the key.
        """
        return cls(parse_id(session_id), parse_key(key), role, topics_from_api(topics))


def parse_id(text: str) -> int:
    """Read a session id of 16 hexadecimal digits.

    Raises:
        ValueError: It is none.
    """
    try:
        if len(text) != 16:
            raise ValueError
        return int.from_bytes(bytes.fromhex(text))
    except ValueError:
        raise ValueError("session: id must be 16 hexadecimal digits") from None


def parse_key(text: str) -> bytes:
    """Read a session key in base64.

    Raises:
        ValueError: It is none, or not of 32 bytes. The text does not hold it.
    """
    try:
        key = base64.b64decode(text, validate=True)
    except (ValueError, binascii.Error):
        key = b""
    if len(key) != KEY_BYTES:
        raise ValueError(f"session: key must be {KEY_BYTES} bytes in base64")
    return key


def topics_from_api(specs: Iterable[TopicSpec]) -> tuple[Topic, ...]:
    """A table of the schema; calls become two topics each."""
    return tuple(topic_from_api(row) for spec in specs for row in spec.rows())


def topic_from_api(spec: TopicSpec) -> Topic:
    """Milliseconds of the schema to seconds of the bridge."""
    return Topic(
        name=spec.name,
        type=spec.type,
        direction=Direction(spec.direction),
        type_hash=spec.type_hash,
        encoding=spec.encoding,
        priority=spec.priority,
        period=None if spec.period_ms is None else spec.period_ms / 1000,
        lifespan=spec.lifespan_ms / 1000,
        depth=spec.depth,
        delivery=spec.delivery,
        reliable=spec.reliable,
        latched=spec.latched,
        compression="" if spec.compression == "none" else spec.compression,
        paths=PathUse(spec.paths),
    )
