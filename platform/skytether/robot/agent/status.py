"""How the robot is, for whoever asks on the robot itself: ``/status`` as JSON, ``/metrics`` for Prometheus.

On loopback only: there is no password, and nothing in it is secret or changes anything.
"""

from __future__ import annotations

import errno
import json
import logging
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, HTTPServer
from math import isfinite
from socketserver import TCPServer, ThreadingMixIn
from typing import Any

from skytether.api import rest
from skytether.api.exposition import Family, Sums, counter, exposition, gauge
from skytether.api.hosts import is_own
from skytether.api.report_metrics import of_report

from ..offload.task_manager import OffloadDecision, Option
from .snapshot import AgentStatus

_log = logging.getLogger(__name__)

DEFAULT_PORT = 8610
PORTS = 16
"""Tried one after the other, the configured one first: there may be several robots on a machine."""
_LOOPBACK = "127.0.0.1"
_PATIENCE_S = 2.0
_MOST = 16
"""Connections at a time, each of which has a thread; who comes on top is closed."""
_ACCOUNT = ("published", "refused", "dropped", "sent", "delivered", "superseded", "lost", "unsettled")
"""What becomes of messages; it adds up: see `skytether.wire.stats.TopicStats`."""
_TRANSITIONS = 20
"""The newest that ``/status`` tells."""


def document(robot: str, service: str, status: AgentStatus, now: float) -> dict[str, Any]:
    """What ``/status`` says.

    Args:
        robot: Its name.
        service: What it wants.
        status: The agent's.
        now: Monotonic seconds, for ages.
    """
    driver, instance = status.driver, status.instance
    site = instance.placement.site if instance and instance.placement else None
    return {
        "robot": robot,
        "service": service,
        "source": driver.source,
        "why": driver.why,
        "trouble": status.trouble,
        "task": None if status.decision is None else _decision(status.decision, now),
        "instance": None
        if instance is None
        else {"id": instance.id, "state": instance.state, "site": site, "reason": instance.reason},
        "link": {
            "connected": status.connected,
            "rtt_ms": _ms(status.rtt),
            "loss": _known(status.loss),
            "late": _known(status.late),
            "paths": [
                {
                    "path": path.path,
                    "rtt_ms": _ms(path.rtt),
                    "loss_out": _known(path.loss_out),
                    "loss_in": _known(path.loss_in),
                    "health": path.health,
                    "mtu": path.mtu,
                }
                for path in (status.session.paths if status.session else ())
            ],
        },
        "topics": _topics(status),
        "other_publishers": {"names": list(status.others.names), "noticed": status.others.noticed},
        "velocity": {"linear_m_s": driver.velocity.linear, "angular_rad_s": driver.velocity.angular},
        "gate": None if status.gate is None else status.gate.model_dump(),
        "told": None
        if driver.told is None
        else {"linear_m_s": driver.told.velocity.linear, "angular_rad_s": driver.told.velocity.angular},
        "robot_load": _known(status.load),
        "battery": status.battery,
        "seconds": {str(source): round(seconds, 2) for source, seconds in driver.seconds.items()},
        "transitions": [
            {"ago_s": round(now - change.at, 2), "source": change.source, "reason": change.reason}
            for change in driver.transitions[-_TRANSITIONS:]
        ],
        "commands": driver.commands,
        "missed_commands": driver.missed_commands,
        "objections": dict(driver.objections),
        "errors": dict(driver.errors),
        "overruns": status.overruns,
        "stalls": driver.stalls,
        "silence_limit_ms": _ms(driver.silence_limit_s),
        "log_lines_dropped": status.log_lines_dropped,
    }


def metrics(robot: str, service: str, status: AgentStatus, report: rest.Report) -> bytes:
    """What ``/metrics`` says: the report that the orchestrator gets too, and what is the robot's own business."""
    return exposition(_families(robot, service, status, report))


class StatusServer:
    """Answers in threads of its own. Who asks slowly, or never ends, holds up neither the others nor the end.

    Attributes:
        port: Where it listens on loopback.
    """

    def __init__(
        self,
        port: int,
        status: Callable[[], dict[str, Any]],
        metrics: Callable[[], bytes],
        patience_s: float = _PATIENCE_S,
    ) -> None:
        """Bind and begin, at the first of `ports` that is free.

        Args:
            port: Where to begin to look for one.
            status: What ``/status`` says.
            metrics: What ``/metrics`` says.
            patience_s: For one request, from its first byte to the last of its answer.

        Raises:
            OSError: None is.
        """
        answers: dict[str, Callable[[], tuple[str, bytes]]] = {
            "/status": lambda: ("application/json", json.dumps(status(), allow_nan=False).encode()),
            "/metrics": lambda: ("text/plain; version=0.0.4; charset=utf-8", metrics()),
        }

        class Handler(_Handler):
            pages = answers
            timeout = patience_s

        self._server = _bound(port, Handler, patience_s)
        self.port: int = self._server.server_address[1]
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), name="status", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End."""
        self._server.shutdown()
        self._thread.join(_PATIENCE_S)
        self._server.server_close()


def ports(first: int) -> range:
    """Where the agent listens that was told this one: there, or as near above as is free; 0 is any free one."""
    return range(first, min(first + PORTS, 65_536)) if first else range(1)


def _bound(port: int, handler: type[_Handler], patience_s: float) -> _Server:
    *earlier, last = ports(port)
    for one in earlier:
        try:
            return _Server((_LOOPBACK, one), handler, patience_s)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
    return _Server((_LOOPBACK, last), handler, patience_s)


class _Server(ThreadingMixIn, HTTPServer):
    daemon_threads = True
    block_on_close = False
    request_queue_size = _MOST
    """Come at once, too: of five, which is the default, the sixth had to knock again, a second later."""

    def __init__(self, address: tuple[str, int], handler: type[_Handler], patience_s: float) -> None:
        self._patience_s = patience_s
        self._since: dict[Any, float] = {}
        self.telling = threading.Lock()
        super().__init__(address, handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        if len(self._since) >= _MOST:
            self.shutdown_request(request)
            return
        self._since[request] = time.monotonic()
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        self._since.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """Ten times a second: end whoever takes longer, one byte after the other, say."""
        latest = time.monotonic() - self._patience_s
        for request, since in self._since.copy().items():
            if since < latest:
                with suppress(OSError):  # it has gone by itself
                    request.shutdown(socket.SHUT_RDWR)

    def handle_error(self, *_: object) -> None:
        """Whoever goes away before the answer is not logged."""

    def server_bind(self) -> None:
        """Without the name of the address, for which HTTPServer asks a name server: nobody needs it."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = _LOOPBACK, self.server_address[1]


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    pages: dict[str, Callable[[], tuple[str, bytes]]]
    timeout = _PATIENCE_S

    def do_GET(self) -> None:
        if not all(is_own(host) for host in self.headers.get_all("Host", ())):
            # A web page that has made its name this address (DNS rebinding) is to read nothing.
            self.send_error(421, "ask by address, or as localhost")
            return
        page = self.pages.get(self.path.split("?", 1)[0])
        if page is None:
            self.send_error(404, "there are /status and /metrics")
            return
        try:
            with self.server.telling:
                kind, body = page()
        except Exception as error:  # whoever looks at a robot must not be able to harm it
            _log.debug("status failed", exc_info=error)
            self.send_error(500, "the status cannot be told")
            return
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Looks are not logged."""


def _families(robot: str, service: str, status: AgentStatus, report: rest.Report) -> Iterator[Family]:
    instance = status.instance
    site = instance.placement.site if instance and instance.placement else ""
    yield from of_report((robot, service, site), report)
    seconds, connected, errors, cost, noticed = Sums(), Sums(), Sums(), Sums(), Sums()
    for source, spent in status.driver.seconds.items():
        seconds.add((robot, service, source), spent)
    connected.put((robot, service), float(status.connected))
    noticed.put((robot,), float(status.others.noticed))
    for part, count in status.driver.errors.items():
        errors.add((robot, part), count)
    for option in status.decision.options if status.decision else ():
        cost.put((robot, service, option.name), option.cost)
    yield counter("control_seconds", "Time under each source", ("robot", "service", "source"), seconds.items())
    yield gauge("session_connected", "1 while the bridge has a session", ("robot", "service"), connected)
    yield counter("wheels_other_publishers", "Others found to publish the wheels' topic", ("robot",), noticed.items())
    yield counter("control_errors", "Exceptions caught in the control loop", ("robot", "part"), errors.items())
    stalls = Sums()
    stalls.add((robot, service), status.driver.stalls)
    yield counter("control_stalls", "Times that the control loop stood still", ("robot", "service"), stalls.items())
    labels = ("robot", "service", "option")
    yield gauge("task_cost", "What the task manager reckons for each site and for local; +Inf: ruled out", labels, cost)


def _topics(status: AgentStatus) -> list[dict[str, Any]]:
    """How each topic stands in the robot's graph, and what the bridge has counted of it."""
    counted = {topic.topic: topic for topic in (status.session.topics if status.session else ())}
    followed = {topic.name: topic for topic in status.topics}
    found = []
    for name in (*followed, *(name for name in counted if name not in followed)):
        graph, bridge = followed.get(name), counted.get(name)
        hz = None if bridge is None else status.rates.get((name, bridge.direction))
        found.append(
            {
                "topic": name,
                "direction": None if bridge is None else bridge.direction,
                "hz": None if hz is None else round(hz, 1),
                "graph": None
                if graph is None
                else {
                    "name": graph.graph,
                    "type": graph.type,
                    "way": graph.way,
                    "there": graph.there,
                    "nodes": list(graph.nodes),
                    "quality": graph.quality,
                    "refused": graph.refused,
                    "passed": graph.passed,
                    "dropped": graph.dropped,
                },
                "messages": None if bridge is None else {name: getattr(bridge, name) for name in _ACCOUNT},
            }
        )
    return found


def _decision(decision: OffloadDecision, now: float) -> dict[str, Any]:
    challenger = decision.challenger
    return {
        "offload": decision.offload,
        "site": decision.site,
        "why": decision.why,
        "for_s": round(now - decision.since, 1),
        "options": [_option(option) for option in decision.options],
        "challenger": None
        if challenger is None
        else {"name": challenger[0].name, "for_s": round(now - challenger[1], 1)},
    }


def _option(option: Option) -> dict[str, Any]:
    parts = {name: round(value, 4) for name, value in option.parts.items()}
    return {"name": option.name, "cost": _known(option.cost), "parts": parts, "refused": option.refused}


def _known(value: float) -> float | None:
    return round(value, 4) if isfinite(value) else None


def _ms(seconds: float) -> float | None:
    return round(seconds * 1000, 2) if isfinite(seconds) else None
