"""What an agent is told before it starts: one robot, and the service that it wants."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from skytether.api import rest
from skytether.bridge.interfaces import Wanted

from ..control.arbiter import LinkRequirements
from ..control.supervisor import VelocityLimits
from ..offload.site_prober import TaskConfig

Address = tuple[str, int]


@dataclass(frozen=True, slots=True)
class AgentConfig:
    """One robot and the service it wants.

    Attributes:
        robot: Its name at the orchestrator.
        url: The orchestrator's base address.
        token: The robot's.
        service: What it asks for.
        params: The service's parameters.
        measurements: What it measured towards the sites, by site.
        fallback: Entry point of the group ``skytether.fallbacks``.
        fallback_options: The fallback's.
        limits: The supervisor's; from here only.
        needs: The arbiter's patience, and what the link must be like at least. What a session says the service needs
            (``needs.max_rtt_ms`` and ``needs.max_loss`` of its manifest) only tightens that.
        command_topic: The service's topic (geometry_msgs/msg/Twist) that drives the robot.
        rate_hz: Of the control loop.
        lease_s: The instance ends when the robot was not heard of for this long.
        renew_s: Between renewals, which carry the report.
        request_timeout_s: Of each request to the orchestrator.
        bind: Local address of the robot's end of the bridge; port 0: any.
        paths: Networks that the bridge uses side by side, or "auto" (`skytether.bridge.interfaces`); none: `bind` only.
        ca_file: PEM file of the authority of the orchestrator's certificate; none: the system's.
        insecure_http: Whether plain http may leave this machine.
        task: How it is decided whether to ask, and for which site; None: the service is asked for always, at whatever
            site the orchestrator chooses by ``measurements``.
        fresh_token: Gives the robot's token as it is now, when the one in use was refused; None: there is no other.
        status_port: Port on loopback of ``/status`` and ``/metrics``, the next if it is taken; 0: any free one; None:
            there are none.
        gate: Folder of the gate before the wheels; None: there is none.
        stop_from_afar: Whether the orchestrator may stop the robot, by the gate.
        route: Where to send what is meant for the service's address; for experiments with an emulated link.
    """

    robot: str
    url: str
    service: str
    token: str = field(repr=False)
    params: Mapping[str, Any] = field(default_factory=dict)
    measurements: Mapping[str, rest.Measurement] = field(default_factory=dict)
    fallback: str = "stop"
    fallback_options: Mapping[str, Any] = field(default_factory=dict)
    limits: VelocityLimits = field(default_factory=VelocityLimits)
    needs: LinkRequirements = field(default_factory=LinkRequirements)
    command_topic: str = "cmd_vel"
    rate_hz: float = 100.0
    lease_s: float = 15.0
    renew_s: float = 2.0
    request_timeout_s: float = 5.0
    bind: Address = ("0.0.0.0", 0)  # noqa: S104 - the robot has one network or several; who sends is authenticated
    paths: Wanted = ()
    ca_file: str | None = None
    insecure_http: bool = False
    task: TaskConfig | None = None
    fresh_token: Callable[[], str] | None = None
    status_port: int | None = None
    gate: Path | None = None
    stop_from_afar: bool = False
    route: Callable[[str, int], Address] = lambda host, port: (host, port)
