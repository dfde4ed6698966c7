"""One orchestrator: its parts, put together, started and stopped. No HTTP here."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable
from typing import ParamSpec

from sqlalchemy.exc import ProgrammingError, SQLAlchemyError

from skytether.api.report_metrics import Owner
from skytether.api.rest import GateReport, Report, ScrapeTargets
from skytether.guard.clock import now as boottime

from .access.access import Access, Principal
from .access.disk_usage import DiskUsage
from .access.quotas import Quotas
from .access.rotation import Rotation
from .config.settings import Settings
from .config.sites_file import read_groups, read_sites
from .domain.clock_jump import SharedClock
from .domain.counter_totals import CounterTotals
from .domain.discovery import targets
from .domain.errors import OutdatedError
from .domain.overload import Overload
from .domain.rate_limit import RateLimiter
from .domain.security import SecretFileError, Secrets, close_folder
from .groups.demand import Demand
from .groups.groups import Groups, load_provider
from .groups.scaler import Scaler
from .nodes.authority import KEY as NODES_KEY
from .nodes.authority import Authority
from .nodes.enrolment import Enrolment
from .nodes.machines import MachineInvites
from .providers.base import Provider
from .robots.gates import Gates
from .robots.shared_topics import SharedTopics
from .robots.stop_orders import StopOrders
from .runtimes.base import Runtime
from .scheduling.catalog import Catalog
from .scheduling.events import Broker
from .scheduling.instances import Instances
from .scheduling.loops import Loop
from .scheduling.passes import Passes
from .scheduling.placer import Placer
from .scheduling.runtime_entry_points import load_runtime
from .scheduling.sites import Sites
from .store.engine import GONE
from .store.leader import Leadership
from .store.store import Store
from .telemetry.heartbeat import Heartbeat
from .telemetry.metrics import GroupGauges, Metrics, Running, SiteGauges
from .telemetry.reports import PERIOD, Reports

log = logging.getLogger(__name__)

_Args = ParamSpec("_Args")
_STOP_POLL = 0.02
_SECOND = 1.0
_FIRST_LOOK = 5.0
"""Seconds that the database gets to say who leads, before requests are answered all the same."""


class Orchestrator:
    """Everything behind the HTTP interface."""

    def __init__(
        self,
        settings: Settings,
        clock: Callable[[], float] | None = None,
        find_runtime: Callable[[str], type[Runtime]] = load_runtime,
        find_provider: Callable[[str], type[Provider]] = load_provider,
    ) -> None:
        """Read or make the secrets; nothing runs before ``start``.

        Args:
            settings: Its state folder is made if it is not there.
            clock: Seconds since the epoch; None: the database server's, where there is one, or this machine's.
            find_runtime: Gives a runtime by its name; by entry point unless told otherwise.
            find_provider: Likewise a provider of machines.

        Raises:
            SecretFileError: A file that holds a secret cannot be used, or others could read the state folder.
        """
        close_folder(settings.state_dir, with_database=settings.database_url is None)
        self.settings = settings
        self._outdated_since: float | None = None
        self._told_why = ""
        secrets = self._secrets = Secrets(settings.secrets_dir or settings.state_dir)
        database = settings.database_url or f"sqlite:///{settings.state_dir / 'state.db'}"
        self.broker = Broker()
        self.store = Store(
            database,
            settings.quotas.robot_names,
            key_id=secrets.fingerprint,
            on_change=self.broker.publish,
        )
        self._shared_clock = SharedClock(self.store.now, boottime, time.time) if self.store.served else None
        clock = self.clock = clock or self._shared_clock or time.time
        self.rotation = Rotation(settings.secrets_dir or settings.state_dir, secrets, self.store, clock)
        self.keeper = Loop("secrets", self._unless_outdated(self.rotation.refresh), time.monotonic)
        self.sites = Sites(settings.state_dir / "sites", self.store, settings.timing, find_runtime)
        self.disk_usage = DiskUsage(self.sites.stored, settings.quotas, self.sites.hosted)
        self.quotas = Quotas(self.store, settings.quotas, self.disk_usage)
        self.reports = Reports(self.store, self.quotas.drop_names)
        self.gates = Gates(self.store, settings.timing.gate_silent, clock)
        self.shared_topics = SharedTopics(self.store, clock)
        self.heartbeat = Heartbeat(self.store, settings.advertise, clock)
        self.leadership = Leadership(self.store.lock())
        self.metrics = Metrics(
            self._running,
            settings.limits.reported_topics,
            self._site_gauges,
            self._reports,
            self._accounts,
            self._gates,
            self.quotas,
            lambda: self.leadership.epoch,
            self._group_gauges,
        )
        self.catalog = Catalog(self.store, settings.catalog)
        self.overload = Overload()
        limiter = RateLimiter(settings.limits.requests_per_s, settings.limits.requests_burst, time.monotonic)
        self.access = Access(self.store, secrets, clock, limiter)
        self.stop_orders = StopOrders(self.store, clock)
        self.authority: Authority | None = None
        self.nodes: Enrolment | None = None
        """Machines that joined; None: none can."""
        self.node_port = settings.nodes.port
        """TCP port where they connect."""
        if settings.nodes.port is not None:
            self.authority = Authority(settings.secrets_dir or settings.state_dir, clock)
            days, renew_days = settings.nodes.certificate_days, settings.nodes.renew_days
            self.nodes = Enrolment(self.store, self.sites, self.authority, clock, days, renew_days, settings.nodes.urls)
        invites = MachineInvites(self.nodes, settings.nodes.urls)
        self.groups = Groups(settings.state_dir / "groups", self.store, find_provider, invites.lacks)
        demand = Demand(self.store, self.groups, self.sites, clock, settings.weights)
        placer = Placer(
            self.store,
            self.sites,
            settings.weights,
            self.leadership,
            site_instances=settings.quotas.site_instances,
            disk_usage=self.disk_usage,
            prospects=demand.prospects,
        )
        self._passes: Passes = Passes(
            self.store,
            self.catalog,
            self.sites,
            placer,
            secrets,
            self.metrics,
            settings.timing,
            settings.limits,
            settings.weights,
            clock,
            self._wake_placer,
            self.leadership,
            overload=self.overload,
            disk_usage=self.disk_usage,
            left=self.quotas.left,
        )
        passes = self._passes
        self.scaler = Scaler(
            self.store,
            self.sites,
            passes.successors,
            demand,
            placer.promised,
            self.leadership,
            clock,
            invites,
            wake_placer=self._wake_placer,
            forget_site=self.metrics.forget_site,
        )
        self.placer = Loop("placer", self._unless_outdated(passes.placement.turn), time.monotonic)
        self.writer = Loop("reports", self._unless_outdated(self._write_reports), time.monotonic)
        self.elector = Loop("elector", self._elect, time.monotonic)
        self.instances = Instances(
            self.store,
            self.catalog,
            self.sites,
            placer,
            passes.standbys,
            passes.successors,
            self.metrics,
            self.reports,
            self.gates,
            secrets,
            clock,
            self._wake_placer,
            self.quotas,
        )

    def _wake_placer(self) -> None:
        self.placer.wake()

    def authenticate(self, token: str | None, address: str) -> Principal:
        """Find out who asks: see ``Access.authenticate``.

        Raises:
            OutdatedError: This orchestrator has no say any more.
        """
        if self.refuses:
            raise OutdatedError
        return self.access.authenticate(token, address)

    def recent(self, token: str | None, address: str) -> Principal | None:
        """Who showed this token in the last seconds: see ``Access.recent``. Does not wait."""
        return None if self.refuses else self.access.recent(token, address)

    def spend(self, caller: Principal) -> None:
        """Take a request of who was known a moment ago: see ``Access.spend``."""
        self.access.spend(caller)

    def verify(self, token: str | None) -> Principal:
        """As ``authenticate``, without taking a request.

        Raises:
            OutdatedError: This orchestrator has no say any more.
        """
        if self.refuses:
            raise OutdatedError
        return self.access.verify(token)

    def charge(self, caller: Principal, length: int) -> None:
        """Reckon what a body of this length costs whoever sent it."""
        self.access.charge(caller, length)

    def start(self) -> None:
        """Bring the database up to date, load the catalog, adopt what runs, begin to reconcile.

        Raises:
            InvalidError: The catalog's folder, or the file of sites, is wrong.
            SecretFileError: The database belongs to orchestrators with another secret key.
        """
        self.catalog.load(self.settings.catalog_dir)
        file = self.settings.sites_file
        declared, groups = (read_sites(file), read_groups(file)) if file else ([], [])
        self.store.migrate()
        if self._shared_clock is not None:
            self._shared_clock.sync()
        if not self.rotation.agree():
            raise SecretFileError(
                "the database belongs to orchestrators with another secret.key: give this one the same (--secrets-dir)"
            )
        if self.authority is not None and not self.store.agree(NODES_KEY, self.authority.pin):
            raise SecretFileError(
                f"the database belongs to orchestrators with another {NODES_KEY}: give this one the same "
                "(--secrets-dir), or no machine that joined is let in"
            )
        self.elector.start()
        self.elector.wait_first(_FIRST_LOOK)
        self.sites.start(self._unless_outdated(self._passes.reconciler.site_turn), self.settings.local_site, declared)
        self.groups.start(self._unless_outdated(self.scaler.turn), groups)
        self.placer.start()
        self.writer.start()
        self.keeper.start()

    def _write_reports(self) -> float:
        with contextlib.suppress(*GONE):  # they are kept until it answers
            self._write()
            self.heartbeat.beat()
            # Another one leads, and cannot know whom this one refused.
            if not self.leadership.leads and (self.overload.felt() or self.overload.owed()):
                self.store.extend_leases(self.clock(), at_least=True)
        return PERIOD

    def _write(self) -> None:
        self.reports.write()
        self.gates.write()
        self.shared_topics.sync()

    def _elect(self) -> float:
        if self.check_outdated():
            self.leadership.end()
            return _SECOND
        delay = self.leadership.step()
        if self._shared_clock is not None:
            with contextlib.suppress(*GONE):
                self._shared_clock.sync()
        return delay

    def _unless_outdated(self, step: Callable[_Args, float]) -> Callable[_Args, float]:
        """A loop's step that waits from then on."""

        def guarded(*args: _Args.args, **kwargs: _Args.kwargs) -> float:
            try:
                return _SECOND if self.outdated else step(*args, **kwargs)
            except ProgrammingError:
                if not self.check_outdated():
                    raise
                return _SECOND

        return guarded

    @property
    def outdated(self) -> bool:
        """A newer orchestrator has changed the database's schema: this one does nothing more."""
        return self._outdated_since is not None

    @property
    def refuses(self) -> bool:
        """It has been outdated for so long that the newer one serves."""
        since, grace = self._outdated_since, self.settings.timing.outdated_grace
        return since is not None and time.monotonic() - since >= grace

    def check_outdated(self) -> bool:
        """Whether a newer orchestrator has changed the database's schema; the last answer while that is away."""
        try:
            outdated = self.store.outdated()
        except GONE:
            return self.outdated
        if outdated and not self.outdated:
            log.error("a newer orchestrator has brought the database to its schema: end this one, or update it")
            self._outdated_since = time.monotonic()
        elif not outdated:
            self._outdated_since = None
        return outdated

    def stop(self) -> None:
        """Stop reconciling; with ``stop_instances`` end all instances first, otherwise they run on."""
        self.broker.close()
        self.placer.stop(timeout=1.0)  # first: each instance that ends would have it look for a place for all that wait
        if self.settings.stop_instances:
            self._stop_instances()
        self.groups.stop()
        self.sites.stop()
        self.keeper.stop(timeout=1.0)
        self.writer.stop(timeout=1.0)
        self._write_last()
        self.heartbeat.end()
        self.elector.stop(timeout=1.0)
        self.leadership.end()
        self.store.close()

    def _write_last(self) -> None:
        try:
            if not self.outdated:
                self._write()
        except SQLAlchemyError as error:
            log.warning("the robots' last reports are lost, for the database does not take them: %s", error)

    def _stop_instances(self) -> None:
        # Twice the grace: once for the services, once for what comes before and after.
        deadline = time.monotonic() + 2 * self.settings.timing.stop_grace
        while live := self.store.live():
            for record in live:
                self.instances.end(record, "the orchestrator was stopped")
            if time.monotonic() > deadline:
                log.error("%d instances did not end in time", len(live))
                return
            time.sleep(_STOP_POLL)

    def not_ready(self) -> str:
        """Why it cannot do its work now; empty: it can."""
        try:
            self.store.ping()
        except Exception as error:  # whatever the database's driver raises
            self._log_once(f"the database does not answer: {error}")
            return "the database does not answer"  # anybody may ask: what a driver says is for the log
        if self.outdated:
            return str(OutdatedError())
        silent = time.monotonic() - self.placer.last_pass
        if silent > self.settings.timing.lock_up:
            return f"the reconciler has made no pass for {silent:.0f} s"
        return ""

    def _log_once(self, why: str) -> None:
        """Once, however often it is asked."""
        if why != self._told_why:
            self._told_why = why
            log.warning("%s", why)

    def scrape_targets(self, asked: str) -> list[ScrapeTargets]:
        """For Prometheus: the orchestrators over this database; ``asked``: the address that the request was sent to."""
        return targets(self.heartbeat.addresses(), self.settings.advertise, asked)

    def _running(self) -> list[Running]:
        self.reports.write()  # what robots told before a scrape is in it
        if not self.leadership.leads:
            return []  # the one that leads exports them
        running = []
        for record in self.store.live():
            site = self.sites.find(record.site)
            seen = site.observed.get(record.id) if site else None
            running.append(Running(record, seen))
        return running

    def _reports(self) -> dict[str, Report]:
        if not self.leadership.leads:
            return {}
        return {instance: Report.model_validate(report) for instance, report in self.store.reports().items()}

    def _gates(self) -> dict[str, GateReport]:
        return self.gates.fresh() if self.leadership.leads else {}

    def _accounts(self) -> dict[Owner, CounterTotals]:
        return self.store.accounts() if self.leadership.leads else {}

    def _site_gauges(self) -> list[SiteGauges]:
        if not self.leadership.leads:
            return []
        return [
            SiteGauges(site.name, None if site.unreachable else site.capacity, site.load) for site in self.sites.all()
        ]

    def _group_gauges(self) -> list[GroupGauges]:
        if not self.leadership.leads:
            return []
        machines = self.store.machines()
        return [
            GroupGauges(row.name, row.asked.max, row.failures, [m.stage for m in machines if m.group == row.name])
            for row in self.store.site_groups()
        ]
