"""Zenoh, set up as an expert would for a robot on a bad network, in five ways.

In all of them: shared memory off (large payloads would bypass the network), discovery off, express publishers (no
waiting for a batch), seven priorities by the importance of the topics, what is not sent in time is dropped.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, ClassVar

import zenoh

from skytether.lab.bench.traffic import CAMERA
from skytether.wire.topic import Role

from .base import Deliver, EndSpec, Transport
from .certificate import write_certificate

_PRIORITIES = (
    zenoh.Priority.REAL_TIME,
    zenoh.Priority.INTERACTIVE_HIGH,
    zenoh.Priority.INTERACTIVE_LOW,
    zenoh.Priority.DATA_HIGH,
    zenoh.Priority.DATA,
    zenoh.Priority.DATA_LOW,
    zenoh.Priority.BACKGROUND,
)
_LARGE = 16_000
"""Bytes of payload from which a topic counts as a camera where links are divided by kind."""
_BATCH = 1_400
"""Batches over UDP stay under the path's MTU of 1,500; the default of 65,535 makes IP fragments of them."""


class ZenohTransport(Transport):
    """Common to all; the service listens, the robot connects."""

    LINKS: ClassVar[tuple[str, ...]]
    """Endpoints without port: protocol and options, one for each link."""
    BATCH: ClassVar[int] = 65_535

    def __init__(self, spec: EndSpec, deliver: Deliver) -> None:
        super().__init__(spec, deliver)
        self._session: zenoh.Session | None = None
        self._publishers: dict[int, zenoh.Publisher] = {}

    def start(self) -> None:
        zenoh.init_log_from_env_or("off")  # it writes to standard output, where rows are printed
        self._session = session = zenoh.open(self._config())
        for index in self.spec.receives:
            session.declare_subscriber(f"bench/{index}", self._receiver(index))
        for index in self.spec.sends:
            self._publishers[index] = session.declare_publisher(
                f"bench/{index}",
                congestion_control=zenoh.CongestionControl.DROP,
                priority=self.priority(index),
                express=True,
                reliability=self.reliability(index),
            )

    def connected(self) -> bool:
        # Zenoh's stubs take the status for a bool; as one, it is always true.
        matched = (p.matching_status.matching for p in self._publishers.values())  # type: ignore[attr-defined]
        return self._session is not None and all(matched)

    def publish(self, index: int, payload: bytes) -> None:
        self._publishers[index].put(payload)

    def stop(self) -> None:
        if self._session is not None:
            self._session.close()  # type: ignore[no-untyped-call]

    def priority(self, index: int) -> zenoh.Priority:
        """Zenoh's priority of a flow."""
        return _PRIORITIES[min(self.spec.flows[index].rank, len(_PRIORITIES)) - 1]

    def reliability(self, index: int) -> zenoh.Reliability:
        """Which of several links a flow takes, where they differ in reliability."""
        del index
        return zenoh.Reliability.RELIABLE

    def is_large(self, index: int) -> bool:
        """Whether a flow is the camera or like it."""
        return self.spec.flows[index].size >= _LARGE or self.spec.flows[index].name == CAMERA.name

    def settings(self) -> dict[str, Any]:
        """Further settings of the configuration, by path."""
        return {}

    def _receiver(self, index: int) -> Any:
        return lambda sample: self.deliver(index, sample.payload.to_bytes())

    def _config(self) -> zenoh.Config:
        host, port = self.spec.address
        endpoints = [_endpoint(link, host, port + i) for i, link in enumerate(self.LINKS)]
        listens = self.spec.role is Role.SERVICE
        settings: dict[str, Any] = {
            "mode": "peer",
            "listen/endpoints": endpoints if listens else [],
            "connect/endpoints": [] if listens else endpoints,
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "transport/shared_memory/enabled": False,
            "transport/unicast/max_links": len(endpoints),
            "transport/link/tx/batch_size": self.BATCH,
            **self.settings(),
        }
        config = zenoh.Config()
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        return config


class ZenohTcp(ZenohTransport):
    """One TCP link."""

    TCP = True
    ABOUT = "Zenoh, one TCP link"
    LINKS = ("tcp",)


class ZenohTwoTcp(ZenohTransport):
    """A TCP link for the camera, another for the rest.

    Zenoh divides links by ranges of priorities, so here the camera has the lowest, whatever its rank.
    """

    TCP = True
    ABOUT = "Zenoh, two TCP links by priority: the camera alone on the lower one"
    LINKS = ("tcp?prio=1-6", "tcp?prio=7-7")

    def priority(self, index: int) -> zenoh.Priority:
        if self.is_large(index):
            return zenoh.Priority.BACKGROUND
        return _PRIORITIES[min(self.spec.flows[index].rank, len(_PRIORITIES) - 1) - 1]


class ZenohUdp(ZenohTransport):
    """One UDP link."""

    ABOUT = f"Zenoh, one UDP link, batches of at most {_BATCH} bytes"
    LINKS = ("udp",)
    BATCH = _BATCH

    def reliability(self, index: int) -> zenoh.Reliability:
        del index
        return zenoh.Reliability.BEST_EFFORT


class ZenohMixed(ZenohTransport):
    """The camera over TCP, the rest over UDP, divided by reliability."""

    TCP = True
    ABOUT = f"Zenoh, the camera on a TCP link, the rest on a UDP link, batches of at most {_BATCH} bytes"
    LINKS = ("tcp?rel=1", "udp?rel=0")
    BATCH = _BATCH

    def reliability(self, index: int) -> zenoh.Reliability:
        return zenoh.Reliability.RELIABLE if self.is_large(index) else zenoh.Reliability.BEST_EFFORT


class ZenohQuic(ZenohTransport):
    """One QUIC link."""

    ABOUT = "Zenoh, one QUIC link"
    LINKS = ("quic",)

    def settings(self) -> dict[str, Any]:
        folder = Path(self.spec.folder)
        if self.spec.role is Role.ROBOT:
            return {"transport/link/tls/root_ca_certificate": str(folder / "authority.pem")}
        _, certificate, key = write_certificate(self.spec.address[0], folder)
        return {
            "transport/link/tls/listen_certificate": str(certificate),
            "transport/link/tls/listen_private_key": str(key),
        }


def _endpoint(link: str, host: str, port: int) -> str:
    protocol, _, options = link.partition("?")
    return f"{protocol}/{host}:{port}" + (f"?{options}" if options else "")
