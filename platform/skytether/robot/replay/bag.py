"""Recordings as a robot would send them: topics, times and raw bytes, never decoded.

ROS 1 bags, ROS 2 bags (a folder, or its file) and MCAP files, read by rosbags.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1 import ReaderError as Ros1Error
from rosbags.rosbag2 import Reader as Ros2Reader
from rosbags.rosbag2 import ReaderError as Ros2Error

from ..session.topic_table import Offer


class BagError(Exception):
    """The recording cannot be read; the text says which and why."""


@dataclass(frozen=True, slots=True)
class BagTopic:
    """One topic of a recording."""

    offer: Offer
    messages: int
    definition: str = field(default="", compare=False)
    """Of the type, as the recording has it."""


class Bag:
    """An open recording; a context manager.

    Attributes:
        topics: By name.
        duration: Between the first and the last message [s].

    Raises:
        BagError: It is missing, is no recording, or is damaged.
    """

    def __init__(self, path: Path) -> None:
        if not path.exists():
            raise BagError(f"there is no recording {path}")
        if path.is_dir() and not (path / "metadata.yaml").exists():
            raise BagError(f"the folder {path} is no recording: a ROS 2 bag's has a metadata.yaml")
        self._path = path
        self._stack = ExitStack()
        ros1 = path.suffix == ".bag"
        try:
            reader: Ros1Reader | Ros2Reader = Ros1Reader(path) if ros1 else Ros2Reader(path)
            self._stack.enter_context(reader)
        except Exception as error:  # rosbags lets what it trips over through: UnicodeDecodeError, struct.error, ...
            raise BagError(
                f"{path} is no recording that can be read (ROS 1 bag, ROS 2 bag, MCAP){_why(error)}"
            ) from error
        self._reader = reader
        self.duration = max(0, self._reader.duration) / 1e9 if self._reader.message_count else 0.0
        encoding = "ros1" if ros1 else "cdr"
        self.topics: dict[str, BagTopic] = {}
        for connection in self._reader.connections:
            offer = Offer(connection.msgtype, connection.digest, encoding)
            known = self.topics.get(connection.topic, BagTopic(offer, 0, _definition(connection.msgdef)))
            if known.offer != offer:
                self.close()
                raise BagError(f"{path}: topic {connection.topic} has two types, {known.offer.type} and {offer.type}")
            self.topics[connection.topic] = BagTopic(offer, known.messages + connection.msgcount, known.definition)

    def messages(self, topics: Collection[str]) -> Iterator[tuple[float, str, bytes]]:
        """Everything of these topics in the order of recording: seconds from the recording's start, topic, bytes.

        Raises:
            BagError: It is damaged.
        """
        connections = [connection for connection in self._reader.connections if connection.topic in topics]
        if not connections:
            return
        start = self._reader.start_time
        try:
            for connection, stamp, data in self._reader.messages(connections):
                yield (stamp - start) / 1e9, connection.topic, data
        except Exception as error:  # as above
            raise BagError(f"{self._path} is damaged{_why(error)}") from error

    def close(self) -> None:
        """Close the file."""
        self._stack.close()

    def __enter__(self) -> Bag:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _definition(found: MessageDefinition) -> str:
    return found.data if found.format is MessageDefinitionFormat.MSG else ""


def _why(error: Exception) -> str:
    """What rosbags says, where it knew that it was saying something."""
    return f": {error}" if isinstance(error, Ros1Error | Ros2Error | OSError) else ""
