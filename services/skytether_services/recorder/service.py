"""The shell of the recorder: every topic in, files out, and what happens when the disk is full."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Literal

from skytether.service import AnyInput, Service, ServiceError, param
from skytether_services.recorder.bag import BagFile
from skytether_services.recorder.recording import File, Recording, new_path

MEGABYTE = 10**6


@dataclass(frozen=True)
class Params:
    """What a robot may set when it asks for the service."""

    prefix: str = param(
        "recording", max_length=100, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", doc="begin of each file's name"
    )
    format: Literal["mcap", "bag"] = param("mcap", doc="of ROS 1 messages; bag: what rosbag and rosbags read")
    compression: Literal["zstd", "none"] = param("zstd", doc="of each chunk; images do not get smaller by it")
    chunk_size: float = param(1.0, unit="MB", gt=0, le=64, doc="messages are compressed and written in such pieces")
    flush_period: float = param(1.0, unit="s", gt=0, le=60, doc="a killed recorder loses at most so much")
    max_size: float = param(1024.0, unit="MB", gt=0, doc="a file that has grown to this is closed, the next begun")


class Recorder(Service[Params]):
    """Writes everything that the robot sends to MCAP files in the instance's data directory.

    Foxglove and the `mcap` tools read them all; rosbags reads those of ROS 2 robots, it knows no ROS 1 in MCAP. With
    ``format: bag`` messages of ROS 1 go to ROS 1 bags, which rosbag, rosbags and Foxglove read.

    When a file cannot be written (disk full), it stops recording, says so once, and stays up: ending would make the
    orchestrator start it again and again, with a useless file each time. What was flushed stays readable.
    """

    rate_hz = 20.0
    everything = AnyInput()

    def start(self) -> None:
        folder = self.context.data_dir
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ServiceError(f"cannot make the directory {folder}: {error.strerror}") from error
        if not os.access(folder, os.W_OK | os.X_OK):
            raise ServiceError(f"cannot write into {folder}; give the instance a data directory of its own")
        self._recording = Recording(self._open_file, self.context.epoch, int(self.params.max_size * MEGABYTE))
        self._flush_at = 0.0
        self._failed = False

    def step(self, now: float) -> None:
        try:
            for _ in range(len(self.everything)):
                message = self.everything.take()
                if message is not None and not self._failed:
                    self._recording.write(message)
            if now >= self._flush_at and not self._failed:
                self._flush_at = now + self.params.flush_period
                self._recording.flush()
        except OSError as error:
            self._give_up(error)

    def stop(self) -> None:
        try:
            self._recording.close()
        except OSError as error:
            self._give_up(error)
        self.log.info("%d messages recorded", self._recording.messages)
        if self.everything.dropped:
            self.log.warning("%d messages came faster than they could be written", self.everything.dropped)

    def _open_file(self, unix_time: float, profile: str) -> File | BagFile:
        prefix = "-".join(part for part in (self.params.prefix, self.context.robot) if part)
        bag = self.params.format == "bag" and profile == "ros1"
        path = new_path(self.context.data_dir, prefix, unix_time, ".bag" if bag else ".mcap")
        self.log.info("recording to %s", path)
        if bag:
            chunk = int(self.params.chunk_size * MEGABYTE)
            return BagFile(path, chunk, compressed=self.params.compression != "none")
        metadata = {"robot": self.context.robot, "instance": self.context.instance}
        return File(path, profile, self.params.compression, int(self.params.chunk_size * MEGABYTE), metadata)

    def _give_up(self, error: OSError) -> None:
        self._failed = True
        self._recording.abandon()
        self.log.error(
            "cannot write the recording in %s any more: %s; it ends here, make room and start the service again",
            self.context.data_dir,
            error.strerror or error,
        )
