"""What the two ends of a session tell each other about their graphs, beside the messages. Pure.

Types that only a graph knows (their sums and definitions, so that what comes out can be subscribed and recorded),
services that are there, and parameters that are handed over. It travels as one JSON document on a reliable, latched
topic each way. An end that has no graph does not know these topics, and nothing is told.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from skytether.wire.topic import Direction, Role, Topic

_log = logging.getLogger(__name__)

TYPE = "skytether/msg/GraphNotes"
NOTES = {Role.ROBOT: "skytether/graph/robot", Role.SERVICE: "skytether/graph/service"}
"""The topic on which each end tells."""
MAX_NOTES = 8 * 2**20
"""Bytes of a document; a robot's description has some 100 kB."""


@dataclass(frozen=True, slots=True)
class TypeNote:
    """A type as its publisher tells it: name, MD5 (of ROS 2 the RIHS01) and definition."""

    type: str
    md5: str
    definition: str = ""


@dataclass(frozen=True, slots=True)
class Notes:
    """One end's graph.

    Attributes:
        types: Of topics that this end sends and whose type is not known everywhere, by topic of the bridge.
        services: Types of the services that this end answers and that are there now, by call of the bridge.
        params: Parameters by absolute name.
    """

    types: Mapping[str, TypeNote] = field(default_factory=dict)
    services: Mapping[str, TypeNote] = field(default_factory=dict)
    params: Mapping[str, Any] = field(default_factory=dict)

    def pack(self) -> bytes:
        """As it travels. What JSON cannot hold is left out and named, and so are parameters beyond `MAX_NOTES`."""
        params = {}
        room = MAX_NOTES // 2
        for name, value in self.params.items():
            try:
                size = len(json.dumps(value))
            except (TypeError, ValueError):
                _log.error("parameter %s cannot be handed over: it holds neither text nor numbers", name)
                continue
            if size > room:
                _log.error("parameter %s cannot be handed over: it is too large", name)
                continue
            room -= size
            params[name] = value
        return json.dumps(
            {"types": _pack(self.types), "services": _pack(self.services), "params": params}, separators=(",", ":")
        ).encode()


def topics() -> tuple[Topic, ...]:
    """The rows that both ends add to their tables."""
    return tuple(row(direction.sender) for direction in Direction)


def row(sender: Role) -> Topic:
    """The row by which one end tells."""
    return Topic(
        NOTES[sender],
        TYPE,
        Direction.IN if sender is Role.ROBOT else Direction.OUT,
        priority=20,
        lifespan=60.0,
        depth=1,
        reliable=True,
        latched=True,
        compression="zstd",
    )


def unpack(data: bytes | memoryview) -> Notes | None:
    """Read what the other end told; None if it is nothing of that kind."""
    if len(data) > MAX_NOTES:
        return None
    try:
        document = json.loads(bytes(data))
    except (ValueError, RecursionError):
        return None
    if not isinstance(document, dict):
        return None
    params = document.get("params")
    return Notes(
        _unpack(document.get("types")), _unpack(document.get("services")), params if isinstance(params, dict) else {}
    )


def _pack(notes: Mapping[str, TypeNote]) -> dict[str, list[str]]:
    return {name: [note.type, note.md5, note.definition] for name, note in notes.items()}


def _unpack(rows: object) -> dict[str, TypeNote]:
    if not isinstance(rows, dict):
        return {}
    return {
        name: TypeNote(*row)
        for name, row in rows.items()
        if isinstance(row, list) and len(row) == 3 and all(isinstance(part, str) for part in row)
    }
