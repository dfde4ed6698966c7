"""How the robot is, as ROS's diagnostics tell it (diagnostic_msgs/DiagnosticArray, REP 107).

The values are plain, as `skytether.messages.encode_plain` takes them: the message is the same in ROS 1 and ROS 2.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from enum import IntEnum
from math import isfinite
from typing import Any

from ..control.command import Source
from ..graphs.graph_base import PublishesDiagnostics
from .snapshot import AgentStatus

TOPIC = "/diagnostics"
TYPE = "diagnostic_msgs/msg/DiagnosticArray"
PERIOD_S = 1.0
"""Between two messages, as REP 107 wants it."""


class Level(IntEnum):
    """Of a status."""

    OK = 0
    WARN = 1
    ERROR = 2


def diagnostics(robot: str, service: str, node: str, status: AgentStatus, now: float) -> dict[str, Any]:
    """One message.

    Args:
        robot: Its name.
        service: What it asks for.
        node: The node's, before each status.
        status: The agent's.
        now: Unix time in seconds.
    """
    seconds, rest = divmod(now, 1)
    found = (_control(status), _service(service, status), _session(status), _gate(status))
    return {
        "header": {"stamp": {"sec": int(seconds), "nanosec": int(rest * 1e9)}},
        "status": [
            {
                "level": level,
                "name": f"{node.lstrip('/')}: {name}",
                "message": message,
                "hardware_id": robot,
                "values": [{"key": key, "value": str(value)} for key, value in values.items()],
            }
            for name, level, message, values in filter(None, found)
        ],
    }


_Status = tuple[str, Level, str, Mapping[str, object]]


def _control(status: AgentStatus) -> _Status:
    driver = status.driver
    level = {Source.CLOUD: Level.OK, Source.FALLBACK: Level.WARN}.get(driver.source, Level.ERROR)
    values = {
        "linear [m/s]": f"{driver.velocity.linear:.3f}",
        "angular [rad/s]": f"{driver.velocity.angular:.3f}",
        "hand-overs": sum(driver.transition_counts.values()),
        "overruns": status.overruns,
        **{f"objected: {name}": count for name, count in driver.objections.items()},
    }
    if status.others.names:
        level = Level.ERROR
        values["others publish the wheels' topic"] = ", ".join(status.others.names)
    return "control", level, f"driven by {driver.source}: {driver.why}", values


def _service(service: str, status: AgentStatus) -> _Status:
    instance = status.instance
    values: dict[str, object] = {"asked for": service}
    if instance is not None:
        values["instance"] = instance.id
        values["site"] = instance.placement.site if instance.placement else "-"
    if status.trouble:
        return "service", Level.WARN, status.trouble, values
    if instance is None:
        return "service", Level.WARN, "no instance", values
    return "service", Level.OK, instance.state, values


def _session(status: AgentStatus) -> _Status:
    values: dict[str, object] = {
        "round trip [ms]": f"{status.rtt * 1000:.1f}" if isfinite(status.rtt) else "-",
        "lost": f"{status.loss:.1%}" if isfinite(status.loss) else "-",
    }
    return "session", *_CONNECTED[status.connected], values


_CONNECTED = {True: (Level.OK, "connected"), False: (Level.WARN, "not connected")}


def _gate(status: AgentStatus) -> _Status | None:
    gate = status.gate
    if gate is None:
        return None
    if not gate.answers:
        return "gate", Level.ERROR, "does not answer", {}
    values = {"hand": gate.hand or "-", "zone": gate.zone or "-", "troubles": gate.troubles}
    if gate.stopped:
        return "gate", Level.ERROR, f"stopped: {gate.stopped}", values
    return "gate", Level.WARN if gate.troubles else Level.OK, "has the wheels", values


class Diagnostics:
    """How the agent is, on /diagnostics of a graph that has such.

    Args:
        robot: Its name.
        service: What it asks for.
        graph: Where it is published.
    """

    def __init__(self, robot: str, service: str, graph: PublishesDiagnostics) -> None:
        self._who = robot, service, graph.name
        self._graph = graph
        self._due = 0.0

    def publish(self, status: AgentStatus) -> None:
        """Tell it, if it was not told a moment ago."""
        now = time.monotonic()
        if now < self._due:
            return
        self._due = now + 0.9 * PERIOD_S
        self._graph.publish_diagnostics(TYPE, TOPIC, diagnostics(*self._who, status, time.time()))
