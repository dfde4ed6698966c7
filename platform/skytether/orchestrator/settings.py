"""Everything that can be set, in groups, with unit and reason of each default. Times are in seconds."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8600


def default_state_dir() -> Path:
    """Where a person's orchestrator keeps its state, by the XDG base directory specification."""
    return Path(os.environ.get("XDG_STATE_HOME") or "~/.local/state").expanduser() / "skytether"


@dataclass(frozen=True)
class Timing:
    """How patient the reconciler is."""

    observe: float = 0.2
    """Between two looks at a site where nothing is changing; a killed service is seen within this."""
    observe_changing: float = 0.015
    """The same while something starts or stops: it adds to the time until a robot's first command."""
    place: float = 1.0
    """Between two attempts to place what is waiting for a free site."""
    start_timeout: float = 30.0
    """A service that is not ready by then counts as crashed."""
    stop_grace: float = 5.0
    """From the polite request to end until it is enforced."""
    stable: float = 10.0
    """A run that was ready for this long is no quick failure: the count of failures in a row starts again."""
    max_failures: int = 5
    """Quick failures in a row after which an instance is given up as failed."""
    backoff: float = 0.5
    """Wait before the second restart in a row; it doubles with each. The first comes at once: a robot waits."""
    backoff_max: float = 30.0
    site_silent: float = 10.0
    """A site whose runtime has not answered for this long is unreachable."""
    lock_up: float = 30.0
    """A reconcile loop without a pass for this long makes the orchestrator not ready."""


@dataclass(frozen=True)
class Weights:
    """What placement weighs against milliseconds of delay."""

    cost_ms: float = 1.0
    """Delay that one unit of a site's ``cost`` is worth."""
    spread_ms: float = 2.0
    """Delay that an empty site is worth beside a full one: a few milliseconds, so that near sites fill evenly."""
    unmeasured_ms: float = 200.0
    """Round trip reckoned for a site that was not measured, when the service names no ``max_rtt_ms``."""
    migrate_ms: float = 20.0
    """By how much another site must be better before an instance is moved there."""


@dataclass(frozen=True)
class Limits:
    """Bounds of what is kept and taken."""

    body_bytes: int = 1 << 20
    """Largest request."""
    ended_age: float = 86_400.0
    """How long ended instances, their logs and idempotency keys are kept."""
    ended_count: int = 200
    """The newest ended instances that are kept at most."""
    events: int = 20_000
    """Events kept over all instances, the newest."""
    log_lines: int = 10_000
    """Most lines of a log that one request gets."""
    reported_topics: int = 64
    """Topics of one robot's report that reach /metrics, so that no robot can blow up the number of series."""


@dataclass(frozen=True)
class Settings:
    """One orchestrator."""

    state_dir: Path
    """Database, tokens, secret key, instances' folders. Mode 0700."""
    host: str = DEFAULT_HOST
    """Address to listen on. Loopback, because there is no TLS unless a proxy in front brings it."""
    port: int = DEFAULT_PORT
    """0: any free one; the real address is written to ``address`` in the state folder."""
    database_url: str | None = None
    """SQLAlchemy URL; None: SQLite in the state folder."""
    secrets_dir: Path | None = None
    """Folder of ``secret.key`` and ``operator.token``, the same for all orchestrators over one database; None: the
    state folder."""
    catalogue_dir: Path | None = None
    """Folder of manifests (``*.yaml``, ``*.yml``) beside the built-in ones; None: none."""
    stop_instances: bool = False
    """At shutdown: True ends all instances; False leaves them running, to be adopted at the next start."""
    open_metrics: bool = False
    """True: ``/metrics`` needs no token."""
    timing: Timing = field(default_factory=Timing)
    limits: Limits = field(default_factory=Limits)
    weights: Weights = field(default_factory=Weights)
