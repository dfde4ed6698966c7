"""MCAP files: one channel for each topic, a new file when one is large enough.

Each piece that is written has an end of file behind it, which the next piece overwrites: what a killed recorder leaves
opens in every reader. Only the index is missing then, so a reader has to scan the file.

Format: https://mcap.dev/spec, and https://mcap.dev/spec/registry for the names of encodings.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from skytether.messages import definition_of, hash_of
from skytether.service import RawReceived

from .bag import BagFile

_COMPRESSION = {"zstd": CompressionType.ZSTD, "none": CompressionType.NONE}
_PROFILE = {"cdr": "ros2", "ros1": "ros1"}
_SCHEMA_ENCODING = {"cdr": "ros2msg", "ros1": "ros1msg"}
_END = struct.pack("<BQI", Opcode.DATA_END, 4, 0) + struct.pack("<BQQQI", Opcode.FOOTER, 20, 0, 0, 0) + MCAP0_MAGIC
"""End of a file without a summary: places and checksums of 0 say that there are none."""


class File:
    """One MCAP file, from its first message to its summary.

    Args:
        path: Must not exist yet.
        profile: ``ros1`` or ``ros2``: what all messages in it are; readers of ROS bags ask for it.
        compression: ``zstd`` or ``none``.
        chunk_bytes: Messages are compressed and written in chunks of this size, or smaller ones by `flush`.
        metadata: Put into the file under the name ``skytether``.

    Raises:
        FileExistsError: There is such a file.
        OSError: It cannot be written.
    """

    def __init__(self, path: Path, profile: str, compression: str, chunk_bytes: int, metadata: dict[str, str]) -> None:
        self.path = path
        self._stream: BinaryIO = path.open("xb")
        self._writer = Writer(self._stream, chunk_size=chunk_bytes, compression=_COMPRESSION[compression])
        self._channels: dict[tuple[str, str, str, str], int] = {}
        self._ended_at = 0
        self._writer.start(profile)
        self._writer.add_metadata("skytether", metadata)

    def write(self, message: RawReceived, epoch_ns: int) -> None:
        """Append a message; ``epoch_ns``: Unix time at which the monotonic clock of its times stood at 0."""
        key = (message.topic, message.type, message.hash, message.definition)
        if key not in self._channels:
            self._channels[key] = self._add_channel(message)
        logged = _nanoseconds(message.received_at)
        # As long as the robot's clock is not known, the time of sending is not either.
        published = _nanoseconds(message.sent_at) if math.isfinite(message.sent_at_error) else logged
        self._writer.add_message(
            channel_id=self._channels[key],
            log_time=max(0, logged + epoch_ns),
            publish_time=max(0, published + epoch_ns),
            sequence=message.sequence & 0xFFFFFFFF,
            data=message.payload,
        )
        self._end_for_now()

    def flush(self) -> int:
        """Hand what was written to the system, so that a killed process loses nothing of it.

        Returns:
            Size of the file in bytes.
        """
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._end_for_now()
        return self._stream.tell()

    def close(self) -> None:
        """Write the summary and close; without it a reader has to scan the file."""
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._stream.close()
        except OSError:
            self.abandon()
            raise

    def abandon(self) -> None:
        """Close without anything more to write; what was flushed before stays readable, a file without it goes."""
        with suppress(OSError):
            self._stream.close()
        if not self._ended_at:
            self.path.unlink(missing_ok=True)
            return
        with suppress(OSError), self.path.open("r+b") as stream:
            stream.truncate(self._ended_at)
            stream.seek(self._ended_at)
            stream.write(_END)

    def _end_for_now(self) -> None:
        """If something was written to the stream, put an end of file behind it; what comes next overwrites that."""
        end = self._stream.tell()
        if end == self._ended_at:
            return
        self._stream.write(_END)
        self._stream.flush()
        self._stream.seek(end)
        self._ended_at = end

    def _add_channel(self, message: RawReceived) -> int:
        definition = message.definition or definition_of(message.type, message.encoding)
        schema = self._writer.register_schema(
            name=message.type.replace("/msg/", "/") if message.encoding == "ros1" else message.type,
            encoding=_SCHEMA_ENCODING[message.encoding] if definition else "",
            data=definition.encode(),
        )
        return self._writer.register_channel(
            topic=message.topic,
            message_encoding=message.encoding,
            schema_id=schema,
            metadata={"topic_type_hash": message.hash or hash_of(message.type, message.encoding)},
        )


class Recording:
    """Files one after the other; each begins with a message and is closed when it has grown to ``max_bytes``.

    A robot of both ROS generations gets two at a time, because readers refuse a file that mixes them.

    Args:
        open_file: Makes a file: from the Unix time of its first message, and its profile.
        epoch: Unix time at which the monotonic clock of the messages' times stood at 0.
        max_bytes: Checked at each `flush`.
    """

    def __init__(self, open_file: Callable[[float, str], File | BagFile], epoch: float, max_bytes: int) -> None:
        self.messages = 0
        self._open_file = open_file
        self._epoch = epoch
        self._max_bytes = max_bytes
        self._files: dict[str, File | BagFile] = {}

    def write(self, message: RawReceived) -> None:
        """Append a message, to a new file if there is none.

        Raises:
            OSError: The file cannot be written.
        """
        profile = _PROFILE[message.encoding]
        if profile not in self._files:
            self._files[profile] = self._open_file(message.received_at + self._epoch, profile)
        self._files[profile].write(message, _nanoseconds(self._epoch))
        self.messages += 1

    def flush(self) -> None:
        """Make safe what was written, and begin a new file next time where one is large enough.

        Raises:
            OSError: A file cannot be written.
        """
        for profile, file in list(self._files.items()):
            if file.flush() >= self._max_bytes:
                del self._files[profile]
                file.close()

    def close(self) -> None:
        """End all files.

        Raises:
            OSError: A file cannot be written.
        """
        while self._files:
            self._files.popitem()[1].close()

    def abandon(self) -> None:
        """Give up all files: they cannot be written any more."""
        while self._files:
            self._files.popitem()[1].abandon()


def new_path(folder: Path, prefix: str, unix_time: float, suffix: str = ".mcap") -> Path:
    """Name of a file that does not exist yet: prefix, date and time in UTC, a number if that is taken."""
    moment = datetime.fromtimestamp(unix_time, UTC)
    stem = f"{prefix}-{moment:%Y%m%dT%H%M%S}.{moment.microsecond // 1000:03d}Z"
    path = folder / f"{stem}{suffix}"
    number = 1
    while path.exists():
        number += 1
        path = folder / f"{stem}-{number}{suffix}"
    return path


def _nanoseconds(seconds: float) -> int:
    return round(seconds * 1e9)
