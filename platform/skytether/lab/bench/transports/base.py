"""What a transport must do to be measured. One object is one end; it lives in a process of its own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

from skytether.lab.bench.ros2_program.schedule import Order
from skytether.lab.bench.rows import Notes
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


class Kind(ABC):
    """What is known of a transport before an end is made.

    Attributes:
        TCP: Whether it needs TCP, which the emulator in user space cannot carry.
        TUN: Whether it needs IP packets between namespaces for another reason.
        ABOUT: How it is set up, for the report.
    """

    TCP: ClassVar[bool] = False
    TUN: ClassVar[bool] = False
    ABOUT: ClassVar[str]

    @classmethod  # noqa: B027 - most need nothing that their modules do not import
    def check(cls) -> None:
        """Look whether it can be measured on this machine.

        Raises:
            TransportError: Something is missing; the text says what to install.
        """

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
    def stop(self) -> None:
        """Close everything."""


class Transport(Kind):
    """One end within the harness's process. Made, started, asked until connected, used, stopped."""

    def __init__(self, spec: EndSpec, deliver: Deliver) -> None:
        """Keep what is needed; open nothing."""
        self.spec = spec
        self.deliver = deliver

    @abstractmethod
    def publish(self, index: int, payload: bytes) -> None:
        """Hand over one message; never waits for the network."""


class Program(Kind):
    """One end that is a program of its own, under another interpreter: it sends and notes by itself."""

    def __init__(self, spec: EndSpec) -> None:
        """Keep what is needed; start nothing."""
        self.spec = spec

    @abstractmethod
    def measure(self, order: Order) -> Notes:
        """Send what is ordered, and tell what was sent and what arrived.

        Raises:
            TransportError: The program failed.
        """
