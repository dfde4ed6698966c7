"""Topics of any kind on their way into a service: each message with what its robot tells of its type.

A robot whose graph alone knows a type (the user's own) tells name, hash and definition beside the messages
(`skytether.ros.notes`). Messages that were faster wait for that, in the bridge's thread.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from skytether.messages import Encoding, definition_of
from skytether.ros import notes
from skytether.ros.names import bridge_type
from skytether.wire.events import MessageReceived
from skytether.wire.topic import ANY, Role, Topic

from .mailbox import RawQueue

TOLD = notes.NOTES[Role.ROBOT]
"""The topic by which a robot tells of its types; no service's business, and in no recording."""
_EARLY, _EARLY_BYTES = 1000, 16 * 2**20
"""Messages that wait for what is told of their type, and their bytes; the oldest go on without it."""


def rows(topics: Iterable[str]) -> tuple[Topic, ...]:
    """What a service that takes any topic adds to its table."""
    return (notes.row(Role.ROBOT),) if ANY in topics else ()


class AnyTopics:
    """Between the bridge and a queue of raw messages; all in the bridge's thread."""

    def __init__(self, queue: RawQueue) -> None:
        self._queue = queue
        self._table: dict[str, Topic] = {}
        self._told: dict[str, notes.TypeNote] = {}
        self._unknown: set[str] = set()
        self._early: deque[tuple[MessageReceived, Encoding]] = deque()
        self._early_bytes = 0

    def agree(self, topics: Iterable[Topic]) -> None:
        """A new connection, or its end: what was told of types is of the one before."""
        while self._early:
            self._pass(*self._pop())
        self._table = {topic.name: topic for topic in topics}
        self._told = {}
        tells = TOLD in self._table
        self._unknown = {n for n, row in self._table.items() if tells and not (row.type_hash and _known(row))}

    def put(self, message: MessageReceived, encoding: Encoding) -> None:
        """A message, or what is told of types."""
        if message.topic == TOLD:
            told = notes.unpack(message.payload)
            if told is not None:
                self._told = dict(told.types)
                self._settle()
            return
        if self._waits(message.topic):
            self._early.append((message, encoding))
            self._early_bytes += len(message.payload)
            while len(self._early) > _EARLY or self._early_bytes > _EARLY_BYTES:
                self._pass(*self._pop())
            return
        self._pass(message, encoding)

    def _waits(self, topic: str) -> bool:
        """Whether something will be told of its type and is not yet."""
        return topic in self._unknown and topic not in self._told

    def _settle(self) -> None:
        for _ in range(len(self._early)):
            message, encoding = self._pop()
            if message.topic in self._told:
                self._pass(message, encoding)
            else:
                self._early.append((message, encoding))
                self._early_bytes += len(message.payload)

    def _pop(self) -> tuple[MessageReceived, Encoding]:
        message, encoding = self._early.popleft()
        self._early_bytes -= len(message.payload)
        return message, encoding

    def _pass(self, message: MessageReceived, encoding: Encoding) -> None:
        row, note = self._table[message.topic], self._told.get(message.topic)
        if note is None:
            self._queue.put(message, row.type, encoding, row.type_hash)
        else:
            self._queue.put(message, bridge_type(note.type), encoding, note.md5, note.definition)


def _known(row: Topic) -> bool:
    return bool(definition_of(row.type, "ros1" if row.encoding == "ros1" else "cdr"))
