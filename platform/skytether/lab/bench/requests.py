"""What a fleet asks of its orchestrator: mostly renewals with a report, as each robot sends every few seconds."""

from __future__ import annotations

import json
import queue
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np

from skytether.api.rest import Report, TopicReport

from .open_loop import Request

SERVICE = "sleeper"
_TOPICS: tuple[tuple[str, str, Literal["in", "out"]], ...] = (
    ("/scan", "sensor_msgs/msg/LaserScan", "in"),
    ("/odom", "nav_msgs/msg/Odometry", "in"),
    ("/force", "geometry_msgs/msg/WrenchStamped", "in"),
    ("/cmd_vel", "geometry_msgs/msg/Twist", "out"),
)


def sleeper(topics: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The manifest of a service that sleeps, and of which any number fits on a site."""
    return {
        "apiVersion": "skytether.io/v1",
        "kind": "Service",
        "metadata": {"name": SERVICE},
        "spec": {
            "entrypoint": "skytether.testing.toy_service",
            "topics": list(topics),
            "needs": {"cpu": 0.001, "memory_mb": 1},
        },
    }


MANIFEST = sleeper([{"name": n, "type": t, "direction": d, "priority": 100} for n, t, d in _TOPICS])
"""With the topics of one that follows a walking person."""
_SHARES = {"renew": 0.79, "show": 0.12, "list own": 0.04, "list all": 0.01, "create": 0.02, "delete": 0.02}
"""Of the requests; the operator's console lists all, and each creation is of a robot that lets go some time later."""
_SCRAPE_EVERY = 500
"""One request of so many is Prometheus'."""
_JSON = {"Content-Type": "application/json"}


@dataclass(frozen=True, slots=True)
class Held:
    """A robot with its token and its instance."""

    robot: str
    token: str
    instance: str


class Mix:
    """Draws one request after the other."""

    def __init__(self, held: list[Held], operator_token: str, rng: np.random.Generator) -> None:
        self._held = held
        self._operator = _bearer(operator_token)
        self._rng = rng
        self._made: queue.SimpleQueue[tuple[dict[str, str], str]] = queue.SimpleQueue()
        """Instances to let go."""
        self._count = 0

    def next(self) -> Request:
        """The next request."""
        self._count += 1
        if self._count % _SCRAPE_EVERY == 0:
            return Request("scrape", "GET", "/metrics", self._operator)
        kind = str(self._rng.choice(list(_SHARES), p=list(_SHARES.values())))
        who = self._held[int(self._rng.integers(len(self._held)))]
        own = _bearer(who.token)
        path = f"/api/v1/instances/{who.instance}"
        if kind == "show":
            return Request(kind, "GET", path, own)
        if kind == "list own":
            return Request(kind, "GET", "/api/v1/instances", own)
        if kind == "list all":
            return Request(kind, "GET", "/api/v1/instances", self._operator)
        if kind == "create":
            body = json.dumps({"robot": who.robot, "service": SERVICE, "lease_s": 60}).encode()
            return Request(kind, "POST", "/api/v1/instances", own | _JSON, body, lambda answer: self._keep(own, answer))
        if kind == "delete" and not self._made.empty():
            token, instance = self._made.get()
            return Request(kind, "DELETE", f"/api/v1/instances/{instance}", token)
        return renewal(who)

    def _keep(self, token: dict[str, str], answer: bytes) -> None:
        self._made.put((token, json.loads(answer)["id"]))


def renewal(who: Held) -> Request:
    """A robot that drives reports, and keeps its lease."""
    return Request("renew", "POST", f"/api/v1/instances/{who.instance}/renew", _bearer(who.token) | _JSON, report())


def healthz() -> Request:
    """The cheapest of all."""
    return Request("healthz", "GET", "/healthz")


@cache
def report() -> bytes:
    """A renewal as the agent of a robot that drives sends it."""
    topics = tuple(
        TopicReport(
            topic=name,
            direction=direction,
            priority=100,
            sent=36_000,
            delivered=35_990,
            lost=7,
            late=3,
            bytes_sent=80_000_000,
            delay_p50_s=0.0213,
            delay_p99_s=0.0341,
            jitter_s=0.0021,
        )
        for name, _, direction in _TOPICS
    )
    told = Report(rtt_s=0.0421, topics=topics, control_source="cloud", load=0.31, battery=0.87, overruns=2)
    return json.dumps({"report": told.model_dump(mode="json")}).encode()


def _bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}
