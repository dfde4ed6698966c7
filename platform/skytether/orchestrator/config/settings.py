"""Everything that can be set, in groups, with unit and reason of each default. Times are in seconds.

The text under each field is its documentation: ``skytether orchestrator config`` prints it, and the page
``docs/configuration.md`` is made from it.
"""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, field_validator, model_validator

from skytether.api.hosts import is_ip, is_name
from skytether.api.manifest import Strict
from skytether.api.node import read_url

from ..domain.discovery import is_address
from .defaults import DEFAULT_HOST, DEFAULT_PORT, default_state_dir

Seconds = Annotated[float, Field(gt=0, le=1e9)]
Count = Annotated[int, Field(ge=1, le=1_000_000_000)]
Weight = Annotated[float, Field(ge=0, le=1e6)]


class Group(Strict):
    """Settings that belong together; the docstrings under the fields are their descriptions."""

    model_config = ConfigDict(use_attribute_docstrings=True)


class Timing(Group):
    """How patient the reconciler is, in seconds."""

    observe: Seconds = 0.2
    """Between two looks at a site where nothing is changing; a killed service is seen within this."""
    observe_changing: Seconds = 0.015
    """The same while something starts or stops: it adds to the time until a robot's first command."""
    place: Seconds = 1.0
    """Between two attempts to place what is waiting for a free site."""
    start_timeout: Seconds = 30.0
    """A service that is not ready by then counts as crashed."""
    stop_grace: Seconds = 5.0
    """From the polite request to end until it is enforced."""
    stable: Seconds = 10.0
    """A run that was ready for this long is no quick failure: the count of failures in a row starts again."""
    max_failures: Count = 5
    """Quick failures in a row after which an instance is given up as failed."""
    backoff: Seconds = 0.5
    """Wait before the second restart in a row; it doubles with each. The first comes at once: a robot waits."""
    backoff_max: Seconds = 30.0
    """The longest wait before a restart; and how long a site that failed to start a service gets no more of it."""
    unfit_max: Seconds = 300.0
    """That time doubles with each failure in a row up to this: so long at most until a site that was mended is used."""
    site_silent: Seconds = 10.0
    """A site whose runtime has not answered for this long is unreachable."""
    replace_after: Seconds = 10.0
    """A robot that has driven by itself for this long gets its service moved, if another site would be better."""
    replace_pause: Seconds = 60.0
    """An instance runs for at least this long before it is moved so."""
    standby_lease: Seconds = 15.0
    """Lease of a standby when it is given to a robot that names none."""
    gate_silent: Seconds = 15.0
    """A robot that has not said for this long how its gate is has no series of it, and an unknown state in the list of
    robots. Agents say it every 5 s at least."""
    lock_up: Seconds = 30.0
    """A reconcile loop without a pass for this long makes the orchestrator not ready."""
    outdated_grace: Annotated[float, Field(ge=0)] = 10.0
    """An orchestrator whose database a newer one has changed leads no more, and still answers for this long."""


class Weights(Group):
    """What placement weighs against milliseconds of delay."""

    cost_ms: Weight = 1.0
    """Delay that one unit of a site's `cost` is worth."""
    spread_ms: Weight = 2.0
    """Delay that an empty site is worth beside a full one: a few milliseconds, so that near sites fill evenly."""
    fill_ms: Weight = 20.0
    """The same the other way round, for machines of a group: those in use are filled, as far as waiting for a processor
    lets them, so that the others become idle and are given back."""
    migrate_ms: Weight = 20.0
    """By how much another site must be better before a warm instance is left aside, or a running one is moved."""
    unmeasured_ms: Weight = 200.0
    """Round trip reckoned for a site that was not measured, when the service names no `max_rtt_ms`."""


class ServerLimits(Group):
    """Bounds of what is kept and taken."""

    body_bytes: Count = 1 << 20
    """Largest request."""
    robot_body_bytes: Count = 1 << 19
    """Largest request of a robot: its parameters, or all that it reports with a renewal, 320 bytes for each topic."""
    connections: Count = 8192
    """Open connections of all, at most half of the files that the system lets the program have. Of more, one that has
    shown no good token gives way."""
    connections_per_address: Count = 2048
    """The same of one address (IPv6: one /64 network), as of all robots behind one router; not of `proxies`."""
    strangers: Count = 1024
    """The same of those that have shown no good token, which cost 130 kB each with TLS. Of more, the oldest of the
    address that has most of them gives way."""
    connections_per_robot: Count = 32
    """Of more, the one that was quiet for the longest is closed."""
    head_s: Seconds = 10.0
    """By when a connection has sent the head of a request, TLS included."""
    body_s: Seconds = 30.0
    """By when the body has followed: 1 MB at 300 kbit/s."""
    idle_s: Seconds = 30.0
    """How long a connection is kept for another request."""
    requests_per_s: Annotated[float, Field(gt=0, le=1e6)] = 30.0
    """Requests that one robot's token may make, and one address without a valid token; an operator's are free. Each
    8 KiB of a robot's request count as another one."""
    requests_burst: Count = 100
    """Requests at once above which that rate holds: an agent whose service comes up makes some 60 in five seconds, and
    four every second afterwards."""
    requests_at_once: Count = 256
    """Requests under way, of all callers; whoever comes beyond gets 503 and `Retry-After`, as robots take it. A request
    counts once all of it has arrived from somebody with a good token."""
    requests_for_renewals: Annotated[int, Field(ge=0, le=1_000_000_000)] = 64
    """How many of these are for robots that renew a lease."""
    robot_requests_at_once: Count = 16
    """Requests of one robot under way, those included of which the body has not arrived."""
    ended_age: Seconds = 86_400.0
    """How long ended instances, their logs and idempotency keys are kept."""
    ended_count: Count = 200
    """The newest ended instances that are kept at most."""
    events: Count = 20_000
    """Events kept over all instances, the newest."""
    log_lines: Count = 10_000
    """Most lines of a log that one request gets."""
    reported_topics: Count = 64
    """Topics of one robot's report that reach /metrics, so that no robot can blow up the number of series."""


class Quotas(Group):
    """How much one of them may have, lest it starves the others; all that is refused says which of these did it."""

    robot_instances: Count = 16
    """Instances of one robot that have not ended, those included that it is to change to."""
    robot_cpu: Annotated[float, Field(gt=0, le=1e6)] = 16.0
    """Cores that they need in all."""
    robot_memory_mb: Count = 32_768
    """MiB of memory that they need in all."""
    robot_lease_s: Annotated[float, Field(ge=1, le=86_400)] = 3600.0
    """The longest lease that a robot may ask for: so long it holds what it has after it vanished."""
    robot_data_mb: Count = 51_200
    """MiB that its services may have written and left, at all sites in sum: a day of lasers and two compressed cameras.
    Beyond that nothing is started for it, and what writes is ended; each site's `data_mb` may say less."""
    robot_names: Count = 256
    """Names that a robot makes up in its reports and that get series in /metrics: topics where a manifest takes any,
    reasons, kinds of objections. They count as long as what was counted is kept; what comes under more is dropped."""
    robot_streams: Count = 32
    """Logs and events that one robot follows at a time."""
    streams: Count = 1024
    """The same of all callers."""
    log_streams: Count = 64
    """Logs that are followed at a time, by all: each takes a thread."""
    service_instances: Count = 2000
    """Instances of one service that have not ended."""
    site_instances: Count = 500
    """Instances at one site; more wait for another one, or for room."""
    site_data_mb: Count = 512_000
    """MiB of all robots' data at one site. Beyond that nothing more is started there, and of what runs those end whose
    robots have more than they would have if all had the same."""


class CatalogScope(Group):
    """What a token with the scope `catalog` may have run; the one in the state folder may name anything."""

    modules: tuple[str, ...] = ()
    """Python modules beside those of installed services and of `catalog_dir`. At a site of processes they run on the
    orchestrator's machine; `skytether.service.ros1` and `skytether.service.ros2` start whatever `launch` says."""
    images: tuple[str, ...] = ("*",)
    """Patterns of images, such as `registry.example/*`; each site may narrow them (its `images`)."""


class Tls(Group):
    """HTTPS without a proxy in front: both files, or none."""

    certificate: Path | None = None
    """PEM file of the certificate, with those in between up to the authority's."""
    key: Path | None = None
    """PEM file of its private key, without a password, which only the orchestrator's user, or a group, may read."""

    @model_validator(mode="after")
    def _both(self) -> Tls:
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate and key belong together: give both, or none")
        return self


def syslog_address(text: str) -> str | tuple[str, int]:
    """Of a socket: its path, or IP address and port.

    Raises:
        ValueError: It is none.
    """
    kind, _, rest = text.partition(":")
    host, _, port = rest.rpartition(":")
    if kind == "unix" and rest.startswith("/"):
        return rest
    host = host.removeprefix("[").removesuffix("]")
    if kind == "udp" and is_ip(host) and port.isdigit() and 0 < int(port) < 65_536:
        return host, int(port)
    raise ValueError("must be unix:/PATH or udp:ADDRESS:PORT, with an IP address: no name server is waited for")


class Logs(Group):
    """What is written to standard error, and who did what."""

    format: Literal["text", "json"] = "text"
    """`json`: one object a line (`time, level, logger, message`, and `exception`)."""
    level: Literal["debug", "info", "warning", "error"] = "info"
    """The least important level that is written."""
    audit_file: Path | None = None
    """File for one JSON object a line of each request that changes something or was refused, mode 0600, each line with
    the hash of the one before (`skytether orchestrator audit verify`). At 10 MB it becomes `NAME.000001` and so on, of
    which none is ever deleted here. None, and no `audit_syslog` or `audit_journald`: these go to the log, from the
    logger `skytether.audit`. Requests of who has shown no good token are no part of it: they go to the log, from
    `skytether.strangers`, at most ten a second."""
    audit_syslog: str | None = None
    """`unix:/dev/log` or `udp:ADDRESS:PORT`: the same lines to a syslog, as facility authpriv."""
    audit_journald: bool = False
    """True: the same lines to journald of this machine."""

    @field_validator("audit_syslog")
    @classmethod
    def _reachable(cls, address: str | None) -> str | None:
        if address is not None:
            syslog_address(address)
        return address


class Nodes(Group):
    """Machines that join by themselves, and call the orchestrator (docs/nodes.md)."""

    port: Annotated[int, Field(ge=0, le=65_535)] | None = None
    """TCP port where they connect, such as 8603, always with TLS and certificates of its own; 0: any free one, written
    to `nodes.address` in the state folder. None: no machine can join."""
    host: Annotated[str, Field(min_length=1)] | None = None
    """Address to listen on for them; None: as `host`."""
    urls: tuple[str, ...] = ()
    """`https://HOST:PORT` at which they reach the orchestrators over this database, each of them; none: where they
    joined."""
    certificate_days: Annotated[float, Field(gt=0, le=825)] = 30.0
    """How long a machine's certificate is good for; it is renewed after two thirds of that."""
    renew_days: Annotated[float, Field(ge=0, le=3650)] = 30.0
    """For how long after its end it may still be renewed, by a machine that was away."""

    @field_validator("urls")
    @classmethod
    def _reachable(cls, urls: tuple[str, ...]) -> tuple[str, ...]:
        for url in urls:
            read_url(url)
        return urls


class Settings(Group):
    """One orchestrator."""

    state_dir: Path = Field(default_factory=default_state_dir)
    """Database, tokens, secret key, instances' folders. Mode 0700."""
    host: Annotated[str, Field(min_length=1)] = DEFAULT_HOST
    """Address to listen on; loopback unless told otherwise."""
    port: Annotated[int, Field(ge=0, le=65_535)] = DEFAULT_PORT
    """0: any free one; the real address is written to `address` in the state folder."""
    database_url: str | None = Field(default=None, repr=False)
    """SQLAlchemy URL, `postgresql://user:password@host/name`; none: SQLite in the state folder."""
    secrets_dir: Path | None = None
    """Folder of `secret.key` and `operator.token`, the same for all orchestrators over one database; made (0700) where
    it is not there. None: the state folder. A token in a file `metrics.token` there has the scope `metrics`."""
    catalog_dir: Path | None = None
    """Folder of manifests (`*.yaml`, `*.yml`) beside the built-in ones."""
    sites_file: Path | None = None
    """YAML file of sites by their names, each with `tier`, `runtime`, `options` and what else it has. At the start they
    are made, or become as it says; sites that it does not name stay."""
    stop_instances: bool = False
    """At shutdown: true ends all instances; false leaves them running, to be adopted at the next start."""
    open_metrics: bool = False
    """True: `/metrics` and `/api/v1/prometheus/targets` need no token."""
    advertise: str | None = None
    """`http://HOST:PORT` at which Prometheus reaches this orchestrator, one of several over one database; none: where
    it asked for targets."""
    local_site: bool = True
    """Make the site `local` (processes on this machine) when there is no site at all."""
    echo: bool = True
    """Answer UDP echoes at the same address and port, for `skytether doctor`; never more than was asked."""
    hosts: tuple[str, ...] = ()
    """Names by which it is asked (`Host`), beside those of its machine, `host` and `advertise`; every address and
    `localhost` are good. `*.example.org`: all below; `*`: any, which lets web pages at the operators' browsers ask it
    (DNS rebinding)."""
    proxies: tuple[str, ...] = ()
    """Addresses or networks of proxies in front, whose `X-Forwarded-For` and `X-Forwarded-Proto` are believed."""
    insecure_http: bool = False
    """True: plain HTTP beyond loopback too, where whoever is on the way reads tokens and keys of sessions: for a VPN, a
    bridge network of containers, or the way from a proxy with a certificate, if all of it is yours. Otherwise it does
    not start so."""
    tls: Tls = Tls()
    """HTTPS without a proxy in front."""
    nodes: Nodes = Nodes()
    """Machines that join by themselves."""
    logs: Logs = Logs()
    """What is written down."""
    timing: Timing = Timing()
    """How patient the reconciler is."""
    limits: ServerLimits = ServerLimits()
    """Bounds of what is kept and taken."""
    quotas: Quotas = Quotas()
    """How much one robot, service or site may have."""
    catalog: CatalogScope = CatalogScope()
    """What scope `catalog` may name."""
    weights: Weights = Weights()
    """What placement weighs."""

    @field_validator("proxies")
    @classmethod
    def _addresses(cls, proxies: tuple[str, ...]) -> tuple[str, ...]:
        for proxy in proxies:
            try:
                ipaddress.ip_network(proxy, strict=False)
            except ValueError:
                raise ValueError(f"'{proxy}' is no address and no network such as 10.0.0.0/24") from None
        return proxies

    @field_validator("hosts")
    @classmethod
    def _names(cls, hosts: tuple[str, ...]) -> tuple[str, ...]:
        for host in hosts:
            if not is_name(host):
                raise ValueError(f"'{host}' is not a name such as cloud.example.org or *.example.org: without a port")
        return hosts

    @field_validator("advertise")
    @classmethod
    def _reachable(cls, address: str | None) -> str | None:
        if address is not None and not is_address(address):
            raise ValueError("write http://HOST:PORT or https://HOST:PORT")
        return address

    @field_validator("state_dir", "secrets_dir", "catalog_dir", "sites_file")
    @classmethod
    def _anywhere(cls, path: Path | None) -> Path | None:
        return path.expanduser().absolute() if path else None
