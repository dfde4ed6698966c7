"""Where readings wait until the gate's loop takes them. Stops have a way of their own, never behind readings.

Each topic has its own room, so that none pushes out another's. Of scans and clouds only the newest is kept, and
decoded when it is taken: that bounds what one turn of the loop costs. Of a button, a bumper, a cliff sensor the last
press is kept as well as the newest word, however much came in between.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from skytether.messages import DecodeError, Encoding, LaserScan, Message, PointCloud2, Range, decode

_WAITING = 16
"""Messages of each further topic that wait for the gate's next turn; the newest are kept."""
_LARGEST = 16 << 20
"""Bytes of one message; more is not kept."""
_NEWEST_ONLY = (LaserScan, PointCloud2, Range)

IsStop = Callable[[Message], bool]


@dataclass(frozen=True, slots=True)
class Topics:
    """What is listened to.

    Attributes:
        kinds: Message type by topic.
        stops: Of topics that stop the robot: whether a message does.
    """

    kinds: Mapping[str, type[Message]]
    stops: Mapping[str, IsStop]


class Inbox:
    """Readings and stops, from any thread to the gate's loop.

    Args:
        topics: As configured.
        encoding: Of the bytes.
        trouble: Told a kind and a sentence about each message that is not used; by the loop's thread only.
    """

    def __init__(self, topics: Topics, encoding: Encoding, trouble: Callable[[str, str], object]) -> None:
        self._topics = topics
        self._encoding = encoding
        self._trouble = trouble
        self._lock = threading.Lock()
        self._count = 0
        self._waiting: dict[str, deque[tuple[int, bytes | memoryview]]] = {}
        self._stops: dict[str, list[Message]] = {}
        self._wrong: dict[str, str] = {}

    def put(self, topic: str, data: bytes | memoryview) -> None:
        """From any thread: a message of one of the topics came."""
        if len(data) > _LARGEST:
            with self._lock:
                self._wrong[topic] = f"{len(data)} bytes, {_LARGEST} at most"
        elif topic in self._topics.stops:
            self._put_stop(topic, data)
        else:
            room = 1 if issubclass(self._topics.kinds[topic], _NEWEST_ONLY) else _WAITING
            with self._lock:
                self._count += 1
                self._waiting.setdefault(topic, deque(maxlen=room)).append((self._count, data))

    def drain_stops(self) -> list[tuple[str, Message]]:
        """What was said of stops since the last call: of each topic its last press, and its last word."""
        with self._lock:
            stops, self._stops = self._stops, {}
        return [(topic, message) for topic, messages in stops.items() for message in messages]

    def drain(self) -> list[tuple[str, Message]]:
        """What else came since the last call, oldest first."""
        with self._lock:
            waiting, self._waiting = self._waiting, {}
            wrong, self._wrong = self._wrong, {}
        for topic, sentence in wrong.items():
            self._trouble(f"sensors:{topic}:bytes", f"{topic}: {sentence}")
        found = []
        for _, topic, data in sorted((count, topic, data) for topic, these in waiting.items() for count, data in these):
            try:
                found.append((topic, decode(self._topics.kinds[topic], data, self._encoding)))
            except DecodeError as error:
                self._trouble(f"sensors:{topic}:bytes", f"{topic}: {error}")
        return found

    def _put_stop(self, topic: str, data: bytes | memoryview) -> None:
        try:
            message = decode(self._topics.kinds[topic], data, self._encoding)
        except DecodeError as error:
            with self._lock:
                self._wrong[topic] = str(error)
            return
        is_stop = self._topics.stops[topic]
        with self._lock:
            kept = self._stops.setdefault(topic, [])
            if is_stop(message):
                kept[:] = [message]
            else:
                kept[:] = [*(before for before in kept if is_stop(before)), message]
