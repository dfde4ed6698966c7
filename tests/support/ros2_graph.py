"""A Zenoh router in a process of its own, and a node of rmw_zenoh_cpp played after its documentation.

Nothing here uses our own builders of keys, tokens, attachments or CDR: it is what they are checked against.
"""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest
import zenoh
import zenoh.ext

from skytether.ros.ros2.dialect import Dialect, RmwZenoh
from skytether.ros.ros2.node import Ros2Node

LIMIT_S = 30
"""Until when a condition must have come true; a busy machine may be slow."""

_ROUTER = """
import json, sys, zenoh
config = zenoh.Config()
for key, value in json.loads(sys.argv[1]).items():
    config.insert_json5(key, json.dumps(value))
with zenoh.open(config):
    print("up", flush=True)
    sys.stdin.read()
"""
_ALONE = {"scouting/multicast/enabled": False, "transport/shared_memory/enabled": False}


def until(condition: Callable[[], Any], what: str) -> Any:
    """Wait until something is so."""
    end = time.monotonic() + LIMIT_S
    while not (value := condition()):
        assert time.monotonic() < end, what
        time.sleep(0.02)
    return value


def configuration(**settings: Any) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in {**_ALONE, **settings}.items():
        config.insert_json5(key, json.dumps(value))
    return config


def cdr_string(text: str) -> bytes:
    """std_msgs/msg/String in CDR, little-endian, written by hand."""
    data = text.encode() + b"\0"
    return b"\x00\x01\x00\x00" + len(data).to_bytes(4, "little") + data


class Router:
    """A router that can be stopped and started again on the same port."""

    def __init__(self, **settings: Any) -> None:
        with socket.socket() as found:
            found.bind(("127.0.0.1", 0))
            self.port = found.getsockname()[1]
        self.protocol = "tcp"
        self.settings = settings
        self._process: subprocess.Popen[str] | None = None

    @property
    def address(self) -> str:
        return f"{self.protocol}/127.0.0.1:{self.port}"

    def start(self) -> None:
        settings = {**_ALONE, "mode": "router", "listen/endpoints": [self.address], **self.settings}
        # A module of the tests' own environment, from a directory without surprises.
        self._process = subprocess.Popen(
            [sys.executable, "-c", _ROUTER, json.dumps(settings)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "up\n"

    def stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate(timeout=LIMIT_S)
            self._process = None


@dataclass
class Received:
    """What an oracle's subscription got."""

    samples: list[tuple[bytes, bytes]] = field(default_factory=list)
    """Payload and attachment."""

    @property
    def payloads(self) -> list[bytes]:
        return [payload for payload, _ in self.samples]


class RmwNode:
    """One node of rmw_zenoh_cpp, a Zenoh peer connected to the router, as docs/design.md describes it."""

    GID = bytes(range(100, 116))

    def __init__(self, address: str, name: str, domain: int) -> None:
        self.session = zenoh.open(
            configuration(
                **{
                    "mode": "peer",
                    "connect/endpoints": [address],
                    "listen/endpoints": [],
                    "timestamping/enabled": True,
                }
            )
        )
        self.name, self.domain = name, domain
        self.zid = str(self.session.zid())
        self._count = 0
        self._things: list[Any] = []
        self.tokens: set[str] = set()
        live = self.session.liveliness()
        self._things += [
            live.declare_token(f"@ros2_lv/{domain}/{self.zid}/0/0/NN/%/%/{name}"),
            live.declare_subscriber(f"@ros2_lv/{domain}/**", self._on_token, history=True),
        ]

    def close(self) -> None:
        self.session.close()

    def _on_token(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        if sample.kind == zenoh.SampleKind.PUT:
            self.tokens.add(key)
        else:
            self.tokens.discard(key)

    def sees(self, kind: str, topic: str, ending: str = "") -> list[str]:
        """Others' tokens of one kind and topic."""
        mangled = topic.replace("/", "%")
        return [
            t
            for t in list(self.tokens)
            if f"/{self.zid}/" not in t and f"/{kind}/" in t and f"/{mangled}/" in t and t.endswith(ending)
        ]

    def _token(self, kind: str, topic: str, dds: str, rihs: str, qos: str) -> Any:
        self._count += 1
        key = f"@ros2_lv/{self.domain}/{self.zid}/0/{self._count}/{kind}/%/%/{self.name}/"
        return self.session.liveliness().declare_token(f"{key}{topic.replace('/', '%')}/{dds}/{rihs}/{qos}")

    def key(self, topic: str, dds: str, rihs: str) -> str:
        return f"{self.domain}/{topic.strip('/')}/{dds}/{rihs}"

    @classmethod
    def attachment(cls, sequence: int) -> bytes:
        stamp = time.time_ns()
        return (
            sequence.to_bytes(8, "little", signed=True) + stamp.to_bytes(8, "little", signed=True) + b"\x10" + cls.GID
        )

    def publisher(
        self, topic: str, dds: str, rihs: str, *, qos: str = "::,10:,:,:,,", depth: int = 0
    ) -> Callable[[bytes], None]:
        """Declare a publisher; with a depth it is transient local. Returns what publishes CDR."""
        cached: dict[str, Any] = {}
        if depth:
            qos = f":1:,{depth}:,:,:,,"
            cached = {
                "cache": zenoh.ext.CacheConfig(max_samples=depth),
                "sample_miss_detection": zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
                "publisher_detection": True,
            }
        publisher = zenoh.ext.declare_advanced_publisher(self.session, self.key(topic, dds, rihs), **cached)
        token = self._token("MP", topic, dds, rihs, qos)
        self._things += [publisher, token]
        count = iter(range(1, 10**9))
        return lambda cdr: publisher.put(cdr, attachment=self.attachment(next(count)))

    def subscribe(self, topic: str, dds: str, rihs: str, *, depth: int = 0) -> Received:
        """Declare a subscription; with a depth it is transient local."""
        received = Received()

        def take(sample: zenoh.Sample) -> None:
            assert sample.attachment is not None
            received.samples.append((sample.payload.to_bytes(), sample.attachment.to_bytes()))

        history: dict[str, Any] = {}
        if depth:
            history = {
                "history": zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=depth),
                "recovery": zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
                "subscriber_detection": True,
            }
        subscriber = zenoh.ext.declare_advanced_subscriber(self.session, self.key(topic, dds, rihs), take, **history)
        qos = f":1:,{depth}:,:,:,," if depth else "::,10:,:,:,,"
        self._things += [subscriber, self._token("MS", topic, dds, rihs, qos)]
        return received

    def serve(self, name: str, dds: str, rihs: str, answer: Callable[[bytes], bytes]) -> list[bytes]:
        """Offer a service. Returns the attachments of the requests."""
        seen: list[bytes] = []

        def take(query: zenoh.Query) -> None:
            assert query.payload is not None
            assert query.attachment is not None
            asked = query.attachment.to_bytes()
            seen.append(asked)
            with query:
                # The response carries the request's sequence number and the client's GID.
                attachment = asked[:8] + time.time_ns().to_bytes(8, "little") + asked[16:]
                query.reply(query.key_expr, answer(query.payload.to_bytes()), attachment=attachment)

        queryable = self.session.declare_queryable(self.key(name, dds, rihs), take, complete=True)
        self._things += [queryable, self._token("SS", name, dds, rihs, "::,10:,:,:,,")]
        return seen

    def client(self, name: str, dds: str, rihs: str) -> Callable[[bytes, int], tuple[bytes, bytes]]:
        """Be a client. Returns what calls with a sequence number, and gives back response and attachment."""
        self._things.append(self._token("SC", name, dds, rihs, "::,10:,:,:,,"))

        def call(request: bytes, sequence: int) -> tuple[bytes, bytes]:
            (reply,) = self.session.get(
                self.key(name, dds, rihs),
                target=zenoh.QueryTarget.ALL_COMPLETE,
                consolidation=zenoh.ConsolidationMode.NONE,
                payload=request,
                attachment=self.attachment(sequence),
                timeout=LIMIT_S,
            )
            if reply.ok is None:
                assert reply.err is not None
                raise RuntimeError(reply.err.payload.to_bytes().decode())
            assert reply.ok.attachment is not None
            return reply.ok.payload.to_bytes(), reply.ok.attachment.to_bytes()

        return call


class Stage:
    """A router, nodes of ROS 2 and nodes of ours; every stage has a ROS domain of its own."""

    def __init__(self, router: Router, domain: int) -> None:
        self.router, self.domain = router, domain
        self.said: list[str] = []
        self.until = until
        self.cdr_string = cdr_string
        self._closed: list[Callable[[], object]] = []

    def rmw(self, name: str) -> RmwNode:
        node = RmwNode(self.router.address, name, self.domain)
        self._closed.append(node.close)
        return node

    def ours(self, dialect: Dialect | None = None, **options: Any) -> Ros2Node:
        options = {"router": self.router.address, "say": self.said.append, **options}
        node = Ros2Node(dialect or RmwZenoh(self.domain), **options)
        self._closed.append(node.close)
        node.start()
        return node

    def session(self) -> zenoh.Session:
        """A bare client of the router."""
        session = zenoh.open(configuration(**{"mode": "client", "connect/endpoints": [self.router.address]}))
        self._closed.append(session.close)
        return session

    def close(self) -> None:
        for close in reversed(self._closed):
            close()


@pytest.fixture(scope="session")
def shared_router() -> Iterator[Router]:
    router = Router()
    router.start()
    yield router
    router.stop()


_domains = iter(range(1, 200))


@pytest.fixture
def stage(shared_router: Router) -> Iterator[Stage]:
    """On a router that stays."""
    made = Stage(shared_router, next(_domains))
    yield made
    made.close()


@pytest.fixture
def own_stage() -> Iterator[Stage]:
    """With a router of its own, not started."""
    made = Stage(Router(), 0)
    yield made
    made.close()
    made.router.stop()
