"""The bridge itself, as any service uses it, with its defaults."""

from __future__ import annotations

from hashlib import sha256
from typing import ClassVar

from skytether.bridge import Bridge, SessionSpec
from skytether.bridge.port import Publisher
from skytether.wire import Config
from skytether.wire.events import Connected, Disconnected, Event, MessageReceived
from skytether.wire.topic import Role, Topic

from .base import Deliver, EndSpec, Transport

_TOP = 127
_STEP = 10
"""Between the priorities of successive ranks, the lowest of which is 0."""


class _Port:
    """The bridge's way to the harness."""

    def __init__(self, indices: dict[str, int], deliver: Deliver) -> None:
        self.up = False
        self._indices = indices
        self._deliver = deliver

    def attach(self, publisher: Publisher) -> None:
        """Nothing to subscribe to: the harness publishes by itself."""

    def deliver(self, message: MessageReceived) -> None:
        self._deliver(self._indices[message.topic], message.payload)

    def notify(self, event: Event) -> None:
        self.up = isinstance(event, Connected) or (self.up and not isinstance(event, Disconnected))


class SkytetherTransport(Transport):
    """One session between two bridges.

    Options: ``rate_bps``, the ceiling of the pacing, where the default would be in the way.
    """

    ABOUT: ClassVar[str] = "Skytether's bridge, default settings; delivery and lifespan of each topic as in the table"

    def __init__(self, spec: EndSpec, deliver: Deliver) -> None:
        super().__init__(spec, deliver)
        self._port = _Port({flow.name: i for i, flow in enumerate(spec.flows)}, deliver)
        self._names = [flow.name for flow in spec.flows]
        topics = tuple(
            Topic(
                name=flow.name,
                type="skytether_msgs/msg/Benchmark",
                direction=flow.direction,
                priority=max(_TOP - _STEP * (flow.rank - 1), 0),
                period=1 / flow.hz,
                lifespan=flow.lifespan,
                depth=flow.depth,
                delivery=flow.delivery,
            )
            for flow in spec.flows
        )
        # Both ends run on this machine, against nobody: any key that both know will do.
        key = sha256(spec.folder.encode()).digest()
        session = SessionSpec(1, key, spec.role, topics)
        config = Config(**spec.options)
        listens = spec.role is Role.SERVICE
        self._bridge = Bridge(
            session,
            self._port,
            bind=spec.address if listens else ("0.0.0.0", 0),  # noqa: S104 - the robot's end, behind its emulator
            peer=None if listens else spec.address,
            config=config,
        )

    def start(self) -> None:
        self._bridge.start()

    def connected(self) -> bool:
        return self._port.up

    def publish(self, index: int, payload: bytes) -> None:
        self._bridge.publish(self._names[index], payload)

    def stop(self) -> None:
        self._bridge.stop()
