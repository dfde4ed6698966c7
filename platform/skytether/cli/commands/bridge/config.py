"""The YAML of ``skytether bridge``: schema, key file, and what is said of a mistake in either."""

from __future__ import annotations

import base64
import os
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from skytether.api.config_file import ConfigError, Endpoint, read_config
from skytether.api.manifest import ANY_TOPIC, Strict, TopicSpec
from skytether.bridge.local_network import LocalNetwork
from skytether.bridge.spec import KEY_BYTES, parse_key
from skytether.ros.names import Generation, check_name
from skytether.ros.ros1.config import Ros1Link
from skytether.ros.ros2.config import Ros2Graph
from skytether.wire.topic import Direction, Role


class Source(Strict):
    """A synthetic publisher."""

    topic: str
    size: Annotated[int, Field(ge=0, le=16 * 1024 * 1024)]
    """Bytes of each message."""
    rate_hz: Annotated[float, Field(gt=0, le=100_000)]


class LinkConfig(Strict):
    """One direction of an emulated link."""

    delay_ms: Annotated[float, Field(ge=0, le=60_000)] = 0
    jitter_ms: Annotated[float, Field(ge=0, le=60_000)] = 0
    loss: Annotated[float, Field(ge=0, le=1)] = 0
    burst: Annotated[float, Field(ge=1)] | None = None
    """Mean length of a run of lost packets; null: independent losses."""
    rate_mbps: Annotated[float, Field(gt=0)] | None = None
    seed: int = 0


class EmulatedLink(Strict):
    """An emulated link between both ends."""

    up: LinkConfig = LinkConfig()
    """From the robot to the service."""
    down: LinkConfig = LinkConfig()


class GraphEnd(Strict):
    """What a graph at this end has in either generation of ROS."""

    namespace: str = "/"
    """Of the topics and calls, which are found in the graph under their names."""
    remap: dict[str, str] = {}
    """Other names in the graph, by topic or call."""

    def check_names(self, ros: Generation) -> None:
        """Refuse what this generation refuses.

        Raises:
            ValueError: The text names the key.
        """
        for key, name in {"namespace": self.namespace, **{f"remap.{k}": v for k, v in self.remap.items()}}.items():
            try:
                check_name(name, ros)
            except ValueError as error:
                raise ValueError(f"{key}: {error}") from None


class Ros1End(GraphEnd, Ros1Link):
    """A ROS 1 graph at this end."""

    node: Annotated[str, Field(min_length=1)] = "skytether"
    """Name of our node in the graph."""

    @model_validator(mode="after")
    def _names_are_legal(self) -> Ros1End:
        self.check_names(1)
        try:
            check_name(self.node)
        except ValueError as error:
            raise ValueError(f"node: {error}") from None
        return self


class Ros2End(GraphEnd, Ros2Graph):
    """A ROS 2 graph at this end."""

    @model_validator(mode="after")
    def _names_are_legal(self) -> Ros2End:
        self.check_names(2)
        return self


class BridgeConfig(Strict):
    """One end of a bridge, or both in one process."""

    role: Literal["robot", "service", "both"]
    id: Annotated[str, Field(pattern=r"^[0-9a-fA-F]{16}$", description="16 hexadecimal digits")]
    key_file: Path
    """Made by ``skytether bridge --new-key``; relative to the configuration's folder; the same at both ends."""
    bind: Endpoint = Endpoint()
    peer: Endpoint | None = None
    """Where the service's end listens; for role ``robot``."""
    paths: Literal["auto"] | tuple[LocalNetwork, ...] = ()
    """Networks that the robot's end uses side by side; ``auto``: all that lead out of this machine. Empty: ``bind``."""
    topics: Annotated[tuple[TopicSpec, ...], Field(min_length=1)]
    sources: tuple[Source, ...] = ()
    """Publishers of made-up messages, on topics that this end sends."""
    ros1: Ros1End | None = None
    ros2: Ros2End | None = None
    """The graph at this end, one of the two; null: none, only ``sources``."""
    rate_mbps: Annotated[float, Field(gt=0)] | None = None
    """What this end may send; null: the protocol's default."""
    link: EmulatedLink | None = None
    """Between the two ends of role ``both``."""

    @property
    def roles(self) -> tuple[Role, ...]:
        """The ends that run here."""
        return (Role.SERVICE, Role.ROBOT) if self.role == "both" else (Role(self.role),)

    @model_validator(mode="after")
    def _fits_together(self) -> BridgeConfig:
        names = [t.name for t in self.topics]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"topics: '{name}' is listed twice")
        if self.role == "robot" and (self.peer is None or not self.peer.port):
            raise ValueError("peer: role 'robot' needs the host and port where the service's end listens")
        if self.role != "robot" and self.peer is not None:
            raise ValueError("peer: only role 'robot' has one; the service's end learns where its robot is")
        if self.role == "service" and self.paths:
            raise ValueError("paths: only the robot's end has them; the service's end learns them")
        for key, graph in (("ros1", self.ros1), ("ros2", self.ros2)):
            if graph is not None and (self.role == "both" or self.sources):
                raise ValueError(f"{key}: is for role 'robot' or 'service', and without sources: the graph has its own")
        if self.ros1 is not None and self.ros2 is not None:
            raise ValueError("ros1, ros2: the graph at this end is one of the two")
        if self.role != "both" and self.link is not None:
            raise ValueError("link: only role 'both' can have one; across machines the network is what it is")
        sent = [
            t.name
            for t in self.topics
            if Direction(t.direction).sender in self.roles and t.name != ANY_TOPIC and t.kind == "topic"
        ]
        for i, source in enumerate(self.sources):
            if source.topic not in sent:
                raise ValueError(
                    f"sources.{i}.topic: '{source.topic}' is not sent by role '{self.role}'; it may be one of:"
                    f" {', '.join(sent) or '(none)'}"
                )
        return self


def load_config(path: Path) -> BridgeConfig:
    """Read and check a configuration.

    Raises:
        ConfigError: It cannot be read, is no YAML, or a key is wrong.
    """
    return read_config(path, BridgeConfig)


def load_key(path: Path) -> bytes:
    """Read a key file that nobody else may read.

    Raises:
        ConfigError: It is missing, open to others, or holds no key.
    """
    try:
        with path.open("rb") as file:
            others = os.fstat(file.fileno()).st_mode & 0o077
            text = file.read(256)
    except OSError as error:
        raise ConfigError(
            f"cannot read key_file {path}: {error.strerror}; make one with: skytether bridge --new-key {path}"
        ) from error
    if others:
        raise ConfigError(f"key_file {path} is open to other users; close it with: chmod 600 {path}")
    try:
        return parse_key(text.decode("ascii", errors="replace").strip())
    except ValueError as error:
        raise ConfigError(
            f"key_file {path} holds no key of {KEY_BYTES} bytes in base64;"
            " make one with: skytether bridge --new-key FILE"
        ) from error


def write_new_key(path: Path) -> None:
    """Make a key file with mode 0600.

    Raises:
        ConfigError: It exists already, or cannot be written.
    """
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(base64.b64encode(os.urandom(KEY_BYTES)) + b"\n")
    except FileExistsError as error:
        raise ConfigError(f"{path} exists already and is not overwritten; name another file") from error
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from error
