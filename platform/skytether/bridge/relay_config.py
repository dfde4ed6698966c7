"""The YAML of ``skytether relay``, and its short form in options."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, field_validator, model_validator

from skytether.api.config_file import ConfigError, Endpoint
from skytether.api.manifest import Strict
from skytether.bridge.relay_table import Prefix, RelayLimits

_DEFAULT = RelayLimits()


class Target(Strict):
    """Where the service's ends of some sessions listen, or the next relay."""

    host: Annotated[str, Field(min_length=1)]
    port: Annotated[int, Field(ge=1, le=65_535)]


class RouteConfig(Strict):
    """Where some sessions go."""

    id: str
    """A session's 16 hexadecimal digits, or its first ones and ``*``; the longest that fits counts."""
    target: Target

    @field_validator("id")
    @classmethod
    def _names_sessions(cls, text: str) -> str:
        Prefix.parse(text)
        return text


class RelayLimitsConfig(Strict):
    """Bounds; what they mean is said at `RelayLimits`."""

    sessions: Annotated[int, Field(ge=1, le=65_536)] = _DEFAULT.sessions
    addresses: Annotated[int, Field(ge=1, le=1024)] = _DEFAULT.addresses
    newcomers: Annotated[int, Field(ge=1, le=65_536)] = _DEFAULT.newcomers
    rate_mbps: Annotated[float, Field(gt=0, le=100_000)] = _DEFAULT.rate_bps / 1e6
    idle_s: Annotated[float, Field(ge=1, le=86_400)] = _DEFAULT.idle


class PodsConfig(Strict):
    """Of which pods of a cluster the sessions are forwarded."""

    kubeconfig: str | None = None
    """File that says where the cluster is and who we are; null: the cluster that the relay runs in."""
    context: str | None = None
    """Of the kubeconfig; null: its current one."""
    namespace: Annotated[str, Field(min_length=1)] = "skytether"
    owner: Annotated[str, Field(min_length=1)] | None = None
    """Of one site; null: those of all sites of the namespace."""


class RelayConfig(Strict):
    """One relay."""

    listen: Endpoint = Endpoint(host="0.0.0.0")  # noqa: S104 - a public port is what it is for
    routes: tuple[RouteConfig, ...] = ()
    upstream: Target | None = None
    """Where every session goes that no route names; null: it is not forwarded."""
    kubernetes: PodsConfig | None = None
    """Sessions of pods go to these, as they come and go."""
    limits: RelayLimitsConfig = RelayLimitsConfig()

    @model_validator(mode="after")
    def _goes_somewhere(self) -> RelayConfig:
        if not self.routes and self.upstream is None and self.kubernetes is None:
            raise ValueError("routes: name at least one route, or an upstream for all sessions, or a cluster")
        ids = [Prefix.parse(route.id) for route in self.routes]
        for i, prefix in enumerate(ids):
            if prefix in ids[:i]:
                raise ValueError(f"routes.{i}.id: '{self.routes[i].id}' is listed twice")
        if self.upstream is not None and Prefix(0, 0) in ids:
            raise ValueError("upstream: there is a route '*' for all sessions already; keep one of both")
        return self

    @property
    def bounds(self) -> RelayLimits:
        """As the relay takes them."""
        limits = self.limits
        return RelayLimits(
            limits.sessions, limits.addresses, limits.newcomers, limits.rate_mbps * 1e6, idle=limits.idle_s
        )

    @property
    def targets(self) -> list[tuple[str, Target]]:
        """Which sessions go where."""
        routes = [(route.id, route.target) for route in self.routes]
        return routes if self.upstream is None else [*routes, ("*", self.upstream)]


def parse_endpoint(text: str, option: str) -> tuple[str, int]:
    """Read ``HOST:PORT`` or ``[IPV6]:PORT``.

    Raises:
        ConfigError: It is neither.
    """
    host, colon, port = text.rpartition(":")
    if host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
    elif ":" in host:
        host = ""
    if not colon or not host or not port.isascii() or not port.isdecimal() or int(port) > 65_535:
        raise ConfigError(f"{option}: '{text}' must be HOST:PORT with a port of 0 to 65535, [ADDRESS]:PORT for IPv6")
    return host, int(port)
