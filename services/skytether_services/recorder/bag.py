"""ROS 1 bags (format 2.0), for messages of ROS 1: what rosbag, rosbags and Foxglove read.

Each flush ends the chunk and writes the index behind it, which the next chunk overwrites: what a killed recorder leaves
has an index, too, unless it was killed in the middle of a flush. `rosbag reindex` mends that.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Writer

from skytether.messages import definition_of, hash_of
from skytether.service import RawReceived

_EMPTY = "d41d8cd98f00b204e9800998ecf8427e"
"""MD5 of no definition, for a type that nobody knows: readers compare the two."""


class BagFile:
    """One bag; the same methods as `skytether_services.recorder.recording.File`.

    Args:
        path: Must not exist yet.
        compressed: By LZ4, chunk by chunk; else not at all.
        chunk_bytes: Messages are compressed and written in chunks of this size, or smaller ones by `flush`.

    Raises:
        OSError: It cannot be written.
    """

    def __init__(self, path: Path, chunk_bytes: int, *, compressed: bool) -> None:
        self.path = path
        self._writer = Writer(path)
        if compressed:
            self._writer.set_compression(Writer.CompressionFormat.LZ4)
        self._writer.chunk_threshold = chunk_bytes
        self._writer.open()
        opened: Any = self._writer.bio
        self._stream: BinaryIO = opened
        self._writer.bio = self._kept = _Kept(self._stream)  # type: ignore[assignment]
        self._connections: dict[tuple[str, str, str, str], Connection] = {}

    def write(self, message: RawReceived, epoch_ns: int) -> None:
        """Append a message; ``epoch_ns``: Unix time at which the monotonic clock of its times stood at 0."""
        key = (message.topic, message.type, message.hash, message.definition)
        if key not in self._connections:
            self._connections[key] = self._writer.add_connection(
                message.topic,
                message.type,
                msgdef=message.definition or definition_of(message.type, "ros1"),
                md5sum=message.hash or hash_of(message.type, "ros1") or _EMPTY,
            )
        logged = max(0, round(message.received_at * 1e9) + epoch_ns)
        self._writer.write(self._connections[key], logged, message.payload)

    def flush(self) -> int:
        """Hand what was written to the system, with an index; returns the size of the file in bytes."""
        self._writer.write_chunk(self._writer.chunks[-1])
        end = self._stream.tell()
        self._writer.close()
        self._stream.flush()
        self._writer.bio = self._kept  # type: ignore[assignment]
        self._stream.seek(end)
        return end

    def close(self) -> None:
        """Write the index and close."""
        try:
            self.flush()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close without anything more to write."""
        self._writer.bio = None
        with suppress(OSError):
            self._stream.close()


class _Kept:
    """A stream that the writer does not close."""

    def __init__(self, stream: BinaryIO) -> None:
        self.write, self.tell, self.seek = stream.write, stream.tell, stream.seek

    def close(self) -> None:
        """Not now."""
