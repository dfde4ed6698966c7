"""The shell around the task manager: asks for the sites, probes them, looks at processors and battery, and decides.

In a thread of its own, so that a silent site delays neither driving nor the lease.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite
from typing import Protocol

import psutil

from skytether.api import rest
from skytether.api.client import ApiError, Unreachable
from skytether.api.manifest import Manifest, Needs
from skytether.bridge.echo import EchoClient

from . import task_manager
from .task_manager import OffloadDecision, PathQuality, Policy, RobotView, SiteView, Window

_log = logging.getLogger(__name__)

_LIST_S = 30.0
"""Between looks at the list of sites."""
_MOST_SITES = 32
"""Sites that are probed; the first by name."""
_ECHO_S = 1.0
"""Without an answer by then a probe is lost."""
_REFUSED_S = 60.0
"""A site that placement has refused is not asked for again before."""

Battery = Callable[[], tuple[float, bool] | None]
"""Charge (0 to 1) and whether on mains; None: not known."""


class Sites(Protocol):
    """What is needed of `skytether.api.client.Client`; every call raises ApiError or Unreachable."""

    def sites(self) -> list[rest.Site]:
        """Where instances can run."""
        ...

    def get_service(self, name: str) -> Manifest:
        """What it needs."""
        ...

    def probe(self, site: str) -> float:
        """One round trip [s]."""
        ...


@dataclass(frozen=True, slots=True)
class TaskConfig:
    """How it is decided.

    Attributes:
        policy: Weights and hysteresis.
        echoes: UDP echo (``skytether echo``) of sites that have one; the others are probed through the orchestrator,
            which measures the way to that.
        probe_s: Between probes of each site [s].
        battery: Asked once a second; the default asks the system.
    """

    policy: Policy = field(default_factory=Policy)
    echoes: Mapping[str, tuple[str, int]] = field(default_factory=dict)
    probe_s: float = 1.0
    battery: Battery = lambda: system_battery()


def system_battery() -> tuple[float, bool] | None:
    """The battery that the operating system knows of."""
    found = psutil.sensors_battery() if hasattr(psutil, "sensors_battery") else None
    return None if found is None else (found.percent / 100, bool(found.power_plugged))


class SiteProber:
    """Decides for one robot and one service; `step` is one look, `run` the loop for a thread.

    Args:
        config: How.
        client: The orchestrator.
        service: What the robot wants.
        drives: Whether its own controller drives.
        clock: Monotonic seconds.
        load: Share of the processors that is busy since the last call, 0 to 1.
    """

    def __init__(
        self,
        config: TaskConfig,
        client: Sites,
        service: str,
        *,
        drives: bool,
        clock: Callable[[], float] = time.monotonic,
        load: Callable[[], float] = lambda: psutil.cpu_percent(interval=None) / 100,
    ) -> None:
        self._config = config
        self._client = client
        self._service = service
        self._drives = drives
        self._clock = clock
        self._load = load
        self._needs = Needs()
        self._sites: Sequence[rest.Site] = ()
        self._listed_at: float | None = None
        self._windows: dict[str, Window] = {}
        self._echoes: dict[str, EchoClient] = {}
        self._refused: dict[str, tuple[str, float]] = {}
        self._seen = ("", "")
        """The instance and its site, as last heard."""
        self._here: PathQuality = PathQuality()
        self._lock = threading.Lock()
        self._decision = task_manager.start(config.policy, clock())
        self._robot = RobotView(drives=drives)
        self._told = ""

    @property
    def decision(self) -> OffloadDecision:
        """What stands now; from any thread."""
        return self._decision

    @property
    def robot(self) -> RobotView:
        """The robot at the last look."""
        return self._robot

    def measurements(self) -> dict[str, rest.Measurement]:
        """For a request: what is known of each site, and which is wanted."""
        found = {site.name: self._quality(site.name) for site in self._sites}
        wanted = self._decision.site
        if wanted is not None:
            found.setdefault(wanted, PathQuality())
        return {name: quality.measurement(preferred=name == wanted) for name, quality in found.items()}

    def placed(self, instance: rest.Instance) -> None:
        """The orchestrator has chosen; from any thread."""
        if instance.placement is None:
            return
        site = instance.placement.site
        with self._lock:
            # Heard again, it is no news: where another site was decided on meanwhile, that stands. Heard from another
            # site, the orchestrator has moved it for its own reasons, and is not contradicted before hysteresis allows.
            if (instance.id, site) != self._seen:
                self._seen = (instance.id, site)
                until = self._clock() + _REFUSED_S
                for refusal in instance.placement.refused:
                    self._refused[refusal.site] = (f"refused by the orchestrator: {refusal.detail}", until)
                if self._decision.offload and self._decision.site != site:
                    self._decision = replace(self._decision, site=site)

    def stayed(self, instance: rest.Instance, reason: str) -> None:
        """The site that was wanted could not be had; from any thread."""
        with self._lock:
            wanted = self._decision.site
            if wanted is not None:
                self._refused[wanted] = (reason, self._clock() + _REFUSED_S)
            if instance.placement is not None and self._decision.offload:
                self._decision = replace(self._decision, site=instance.placement.site)

    def live(self, quality: PathQuality) -> None:
        """What the bridge measures towards the service: better than any probe of its site; from any thread."""
        self._here = quality

    def step(self) -> None:
        """One look: probe every site once, and decide."""
        self._list()
        for site in self._sites:
            self._probe(site.name)
        battery = self._config.battery()
        charge, plugged = battery if battery is not None else (None, False)
        self._robot = RobotView(self._load(), os.cpu_count() or 1, charge, plugged, self._drives)
        now = self._clock()
        with self._lock:
            views = [self._view(site, now) for site in self._sites]
            self._decision = task_manager.decide(
                self._config.policy, self._decision, self._needs, views, self._robot, now
            )
        if self._decision.why != self._told:
            self._told = self._decision.why
            _log.warning("task: %s", self._told)

    def run(self, stop: threading.Event) -> None:
        """Look until told to stop."""
        try:
            while not stop.is_set():
                try:
                    self.step()
                except Exception as error:  # a strange answer must not end the deciding
                    _log.debug("deciding failed", exc_info=error)
                stop.wait(self._config.probe_s)
        finally:
            for echo in self._echoes.values():
                echo.close()

    def _list(self) -> None:
        now = self._clock()
        if self._listed_at is not None and 0 <= now - self._listed_at < _LIST_S:
            return
        try:
            self._needs = self._client.get_service(self._service).spec.needs
            self._sites = sorted(self._client.sites(), key=lambda site: site.name)[:_MOST_SITES]
        except (ApiError, Unreachable):
            return  # asked again at the next look; the lease client says what is wrong
        self._listed_at = now
        names = {site.name for site in self._sites}
        self._windows = {name: self._windows.get(name) or Window() for name in names}

    def _probe(self, site: str) -> None:
        window = self._windows[site]
        address = self._config.echoes.get(site)
        if address is None:
            # Where the orchestrator is away, that says nothing about the site.
            with contextlib.suppress(ApiError, Unreachable):
                window.add(self._client.probe(site))
            return
        try:
            echo = self._echoes.get(site) or EchoClient(*address)
        except OSError:
            window.add(None)
            return
        self._echoes[site] = echo
        found = echo.ask(_ECHO_S)
        window.add(None if found is None else found.rtt)

    def _view(self, site: rest.Site, now: float) -> SiteView:
        detail, until = self._refused.get(site.name, ("", 0.0))
        here = self._decision.offload and site.name == self._decision.site
        if now >= until or here:
            detail = ""
        unreachable = detail or ("" if site.state == "ready" else site.reason or "it is unreachable")
        if here and isfinite(self._here.rtt):
            unreachable = ""  # the service there answers, whoever else does not reach it
        return SiteView(site.name, site.tier, self._quality(site.name), unreachable)

    def _quality(self, site: str) -> PathQuality:
        if self._decision.offload and site == self._decision.site and isfinite(self._here.rtt):
            return self._here
        window = self._windows.get(site)
        return window.quality() if window is not None else PathQuality()
