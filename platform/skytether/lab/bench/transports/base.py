"""What a transport must do to be measured. One object is one end; it lives in a process of its own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

from skytether.lab.bench.traffic import Flow
from skytether.wire.topic import Role

Deliver = Callable[[int, "bytes | memoryview"], None]
"""Called with a flow's index and the payload, from any thread, as soon as the message is whole."""


class TransportError(Exception):
    """This transport cannot be measured here; the text says why."""


@dataclass(frozen=True, slots=True)
class EndSpec:
    """One end of a measurement.

    Attributes:
        role: Which end this is. The robot connects, the service listens.
        address: Where to listen, or where to connect to.
        flows: All flows of both directions; known by their index.
        folder: An existing empty folder that both ends share, for files such as certificates.
        options: For the transport alone; what it is called with by a suite.
    """

    role: Role
    address: tuple[str, int]
    flows: tuple[Flow, ...]
    folder: str
    options: dict[str, Any]

    @property
    def sends(self) -> tuple[int, ...]:
        """Indices of the flows that this end sends."""
        return tuple(i for i, flow in enumerate(self.flows) if flow.direction.sender is self.role)

    @property
    def receives(self) -> tuple[int, ...]:
        """Indices of the flows that this end receives."""
        return tuple(i for i, flow in enumerate(self.flows) if flow.direction.sender is not self.role)


class Transport(ABC):
    """One end. Made, started, asked until connected, used, stopped.

    Attributes:
        TCP: Whether it needs TCP, which the emulator in user space cannot carry.
        ABOUT: How it is set up, for the report.
    """

    TCP: ClassVar[bool] = False
    ABOUT: ClassVar[str]

    def __init__(self, spec: EndSpec, deliver: Deliver) -> None:
        """Keep what is needed; open nothing."""
        self.spec = spec
        self.deliver = deliver

    @abstractmethod
    def start(self) -> None:
        """Listen or begin to connect; return without waiting for the other end.

        The service's end is started first.

        Raises:
            TransportError: Something is missing on this machine.
        """

    @abstractmethod
    def connected(self) -> bool:
        """Whether messages of every flow can pass, as far as this end can tell."""

    @abstractmethod
    def publish(self, index: int, payload: bytes) -> None:
        """Hand over one message; never waits for the network."""

    @abstractmethod
    def stop(self) -> None:
        """Close everything."""
