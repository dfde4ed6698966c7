"""Joining the two ends' topic tables (rule 1).

The agreed table is the intersection by name. The robot says what the bytes are (type, hash, encoding), the service
how they are to be carried (priority, lifespan and so on). What cannot be joined is refused with a sentence that
names the topic and both values.
"""

from __future__ import annotations

import json
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from ..topic import ANY, Direction, PathUse, Topic

MAX_TOPICS = 65_535
MAX_TEXT = 4 * 2**20
"""Bytes of a table before compression: more than 10,000 topics."""


class TablesDifferError(Exception):
    """The tables cannot be joined; the text says why."""


def index_topics(topics: Sequence[Topic]) -> dict[str, Topic]:
    """Topics by name, in order.

    Raises:
        ValueError: A name is there twice, or there are too many.
    """
    table = {t.name: t for t in topics}
    if len(table) < len(topics):
        twice, _ = Counter(t.name for t in topics).most_common(1)[0]
        raise ValueError(f"topic {twice}: is in the table twice")
    if len(topics) > MAX_TOPICS:
        raise ValueError(f"a session carries at most {MAX_TOPICS} topics, not {len(topics)}")
    return table


def negotiate(robot: Sequence[Topic], service: Mapping[str, Topic]) -> list[tuple[int, Topic]]:
    """Agreed topics with their indices: position in the robot's table plus 1.

    Raises:
        TablesDifferError: A topic's type, hash or direction differs.
    """
    anything = service.get(ANY)
    agreed = []
    for index, ours in enumerate(robot, 1):
        row = service.get(ours.name)
        if row is None:
            if anything is None or ours.direction is not anything.direction:
                continue
            row = replace(anything, type=ours.type)
        for what, robots, services in (
            ("type", ours.type, row.type),
            ("direction", ours.direction.value, row.direction.value),
            ("type hash", ours.type_hash, row.type_hash),
        ):
            # Hashes of the two generations of ROS say nothing of each other.
            comparable = robots and services and ours.encoding == row.encoding
            if robots != services and (what != "type hash" or comparable):
                raise TablesDifferError(
                    f"topic {ours.name}: the robot has {what} {robots[:80]}, the service {services[:80]}"
                )
        known = row.type_hash if ours.encoding == row.encoding else ""
        joined = replace(row, name=ours.name, type=ours.type, type_hash=ours.type_hash or known, encoding=ours.encoding)
        agreed.append((index, joined))
    return agreed


def push_offer(topics: Sequence[Topic]) -> bytes:
    """The robot's table as it travels in HELLO."""
    return _push([[t.name, t.type, t.direction.value, t.type_hash, t.encoding] for t in topics])


def pull_offer(data: bytes) -> list[Topic]:
    """Inverse of `push_offer`.

    Raises:
        ValueError: Not a table.
    """
    rows = _pull(data)
    if len(rows) > MAX_TOPICS:
        raise ValueError("more topics than a session carries")
    topics = []
    for row in rows:
        name, type_name, direction, type_hash, encoding = _strings(row, 5)
        topics.append(Topic(name, type_name, Direction(direction), type_hash, encoding))
    index_topics(topics)
    return topics


def push_answer(agreed: Sequence[tuple[int, Topic]]) -> bytes:
    """The agreed topics as they travel in WELCOME: the robot knows the rest by index."""
    rows: list[list[Any]] = []
    for i, t in agreed:
        reliability = t.reliable, t.latched, t.compression
        rows.append([i, t.priority, t.period, t.lifespan, t.depth, t.delivery, t.paths.value, *reliability])
    return _push(rows)


def pull_answer(data: bytes, offered: Sequence[Topic]) -> list[tuple[int, Topic]]:
    """Inverse of `push_answer`, given what the robot offered.

    Raises:
        ValueError: Not an answer to that offer.
    """
    agreed = []
    for row in _pull(data):
        if not isinstance(row, list) or len(row) != 10 or not all(isinstance(row[i], int) for i in (0, 1, 4, 7, 8)):
            raise ValueError("not a row of an agreed table")
        index, priority, period, lifespan, depth, delivery, paths, reliable, latched, compression = row
        if not 1 <= index <= len(offered):
            raise ValueError("not a row of an agreed table")
        try:
            topic = replace(
                offered[index - 1],
                priority=priority,
                period=None if period is None else float(period),
                lifespan=float(lifespan),
                depth=depth,
                delivery=float(delivery),
                paths=PathUse(paths),
                reliable=bool(reliable),
                latched=bool(latched),
                compression=compression,
            )
        except (TypeError, OverflowError) as error:
            raise ValueError("not a row of an agreed table") from error
        agreed.append((index, topic))
    return agreed


def _push(rows: list[list[Any]]) -> bytes:
    return zlib.compress(json.dumps(rows, separators=(",", ":")).encode(), 9)


def _pull(data: bytes) -> list[Any]:
    try:
        inflate = zlib.decompressobj()
        text = inflate.decompress(data, MAX_TEXT)
        rows = json.loads(text)
    except (zlib.error, ValueError, RecursionError) as error:
        raise ValueError("not a topic table") from error
    if not inflate.eof or not isinstance(rows, list):
        raise ValueError("not a topic table")
    return rows


def _strings(row: Any, count: int) -> list[str]:
    if not isinstance(row, list) or len(row) != count or not all(isinstance(x, str) for x in row):
        raise ValueError("not a row of a topic table")
    return row
