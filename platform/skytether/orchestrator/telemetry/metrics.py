"""What Prometheus gets. Series exist while what they describe exists; labels never hold an id.

The robot's end of the bridge knows both directions, so topics come from the robots' reports, which arrive with each
renewal, at any of several orchestrators; the one that leads exports them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest

from skytether.api.exposition import Family, Sums, counter, exposition, gauge
from skytether.api.groups import Stage
from skytether.api.manifest import ANY_TOPIC
from skytether.api.report_metrics import INSTANCE, Counts, Described, Owner, counters_of, gates_of, gauges_of
from skytether.api.rest import GateReport, Refusal, Report, Size

from ..access.quotas import Quotas, use_by_robot
from ..domain.counter_totals import CounterTotals, of_instance, of_run
from ..domain.records import Record
from ..runtimes.base import Capacity, Observation

_REASON = re.compile(r"[a-z][a-z0-9_-]{0,39}")
_MAX_REASONS = 32
_BUCKETS = (0.01, 0.025, 0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 2.0, 5.0, 10.0, 30.0)
_RENEWALS = (0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.15, 0.2, 0.5, 1.0, 2.0, 5.0)
USED = {
    "instance_cpu_seconds": Described("Processor time", ("site",)),
    "instance_network_receive_bytes": Described("By the network", ("site",)),
    "instance_network_transmit_bytes": Described("By the network", ("site",)),
    "instance_restarts": Described("Runs that ended by themselves and were begun anew", ("site",)),
}
"""What is counted of instances."""


@dataclass(frozen=True, slots=True)
class Running:
    """A live instance at the moment of a scrape."""

    record: Record
    observation: Observation | None


@dataclass(frozen=True, slots=True)
class SiteGauges:
    """A site at the moment of a scrape; None: not known."""

    name: str
    capacity: Capacity | None
    load: float | None


@dataclass(frozen=True, slots=True)
class GroupGauges:
    """A group of sites at the moment of a scrape."""

    name: str
    most: int
    failures: int
    """In a row."""
    stages: Sequence[Stage]
    """Of its machines."""


class Metrics:
    """The registry of one orchestrator, and what feeds it."""

    def __init__(
        self,
        running: Callable[[], Iterable[Running]],
        max_topics: int,
        sites: Callable[[], Iterable[SiteGauges]] = tuple,
        reports: Callable[[], Mapping[str, Report]] = dict,
        accounts: Callable[[], Mapping[Owner, CounterTotals]] = dict,
        gates: Callable[[], Mapping[str, GateReport]] = dict,
        quotas: Quotas | None = None,
        epoch: Callable[[], int] = int,
        groups: Callable[[], Iterable[GroupGauges]] = tuple,
    ) -> None:
        """All callables are asked at each scrape.

        Args:
            running: What has not ended.
            max_topics: Bounds the topics of a robot's report.
            sites: What is known of the sites.
            reports: The last report on each instance, as ``bounded`` left it.
            accounts: What was counted, by robot and service.
            gates: What robots say of their gates now, by robot.
            quotas: What robots may have, and what was refused for that.
            epoch: As whose leader the orchestrator acts; 0: it does not lead.
            groups: What is known of the groups of sites.
        """
        self._epoch = epoch
        self._groups = groups
        self._quotas = quotas
        self._running = running
        self._sites = sites
        self._reports = reports
        self._accounts = accounts
        self._gates = gates
        self._max_topics = max_topics
        self._registry = CollectorRegistry()
        self._start = Histogram(
            "skytether_instance_start_seconds",
            "From request to placed (placing), from launch to ready (starting), from request to ready (total)",
            ("service", "site", "phase"),
            buckets=_BUCKETS,
            registry=self._registry,
        )
        self._passes = Histogram(
            "skytether_reconcile_pass_seconds",
            "One look at a site and what was done about it",
            ("site",),
            buckets=_BUCKETS,
            registry=self._registry,
        )
        self._renewals = Histogram(
            "skytether_renewal_seconds",
            "From when the head of a robot's renewal was read until its answer began",
            buckets=_RENEWALS,
            registry=self._registry,
        )
        self._refusals = Counter(
            "skytether_placement_refusals",
            "Sites refused in placement",
            ("service", "site", "reason"),
            registry=self._registry,
        )

        self._resizes = Counter(
            "skytether_instance_resizes",
            "Changes of what running instances have",
            ("service", "site", "resource", "direction", "reason"),
            registry=self._registry,
        )
        self._unresized = Counter(
            "skytether_instance_resize_failures",
            "Changes that a site did not make",
            ("service", "site"),
            registry=self._registry,
        )

    def text(self) -> bytes:
        """In Prometheus' text format."""
        return generate_latest(self._registry) + exposition(self._families())

    def phase(self, record: Record, phase: str, seconds: float) -> None:
        """One part of an instance's start; a clock that was set back gives no negative ones."""
        self._start.labels(record.service, record.site or "", phase).observe(max(0.0, seconds))

    def refused(self, service: str, refusals: Iterable[Refusal]) -> None:
        for refusal in refusals:
            self._refusals.labels(service, refusal.site, refusal.reason).inc()

    def resized(self, record: Record, before: Size, after: Size, reason: str) -> None:
        """An instance has more or less than before."""
        for resource, old, new in (("cpu", before.cpu, after.cpu), ("memory", before.memory_mb, after.memory_mb)):
            if new != old:
                direction = "up" if new > old else "down"
                self._resizes.labels(record.service, record.site or "", resource, direction, reason).inc()

    def not_resized(self, record: Record) -> None:
        """It was to have more or less, and its site did not do it."""
        self._unresized.labels(record.service, record.site or "").inc()

    def bounded(self, record: Record, report: Report) -> Report:
        """A robot's report on one instance, without what would make series that nobody declared."""
        rows = [row for topic in record.spec.topics for row in topic.rows()]
        priorities = {(row.name, row.direction): row.priority for row in rows}
        topics = {}
        for topic in report.topics:
            priority = priorities.get((topic.topic, topic.direction), priorities.get((ANY_TOPIC, topic.direction)))
            if priority is not None:
                topics[topic.topic, topic.direction] = topic.model_copy(update={"priority": priority})
        return report.model_copy(
            update={
                "topics": tuple(topics.values())[: self._max_topics],
                "fallback_transitions": _few(report.fallback_transitions),
                "objections": _few(report.objections),
            }
        )

    def reconciled(self, site: str, seconds: float) -> None:
        """One pass over a site."""
        self._passes.labels(site).observe(seconds)

    def renewed(self, seconds: float) -> None:
        """A robot's renewal was answered, and good."""
        self._renewals.observe(seconds)

    def forget_site(self, site: str) -> None:
        self._passes.remove_by_labels({"site": site})
        self._start.remove_by_labels({"site": site})
        for counted in (self._refusals, self._resizes, self._unresized):
            counted.remove_by_labels({"site": site})

    def forget_service(self, service: str) -> None:
        self._start.remove_by_labels({"service": service})
        for counted in (self._refusals, self._resizes, self._unresized):
            counted.remove_by_labels({"service": service})

    def _families(self) -> Iterator[Family]:
        running = list(self._running())
        # After the look at what runs: a run's use is in the account before the run is seen no more.
        accounts, known = dict(self._accounts()), self._reports()
        counted: dict[Owner, CounterTotals] = {}
        places = set()
        for one in running:
            owner = (one.record.robot, one.record.service)
            account = counted.setdefault(owner, accounts.get(owner) or CounterTotals())
            account.merge(*of_instance(one.record))
            if one.observation:
                account.merge(*of_run(one.record, one.observation))
            places.add((*owner, one.record.site or ""))
        sums = {owner: account.sums() for owner, account in counted.items()}
        used = {
            owner: {key: n for key, n in counts.items() if key[0] in USED and (*owner, key[1]) in places}
            for owner, counts in sums.items()
        }
        reports = [(r.record, known[r.record.id]) for r in running if r.record.id in known]
        yield _memory(running)
        yield from _promised(running)
        yield _states(running)
        led = Sums()
        led.put((), self._epoch())
        yield gauge("leader_epoch", "Epoch in which this orchestrator leads; 0: another one does", (), led)
        if self._quotas is not None:
            yield from _of_quotas(self._quotas, running)
        yield _names(accounts, {robot for robot, _ in counted})
        yield from counters_of(used, USED)
        yield from _sites(self._sites(), running)
        yield from _groups(self._groups())
        yield from counters_of(sums)
        yield from gates_of(self._gates())
        yield from gauges_of(
            [
                ((r.robot, r.service, r.site or ""), _known_topics(report, sums[r.robot, r.service]))
                for r, report in reports
            ]
        )


def _known_topics(report: Report, counted: Counts) -> Report:
    """Without topics for whose names there is no room: a gauge each time under another one is a series each time."""
    topics = [t for t in report.topics if ("topic_bytes", t.topic, str(t.priority), t.direction) in counted]
    return report.model_copy(update={"topics": tuple(topics)})


def _names(accounts: Mapping[Owner, CounterTotals], robots: Container[str]) -> Family:
    names = Sums()
    for (robot, _), account in accounts.items():
        if robot in robots:
            names.add((robot,), len(account.names()))
    return gauge("robot_names", "Names that the robot made up in its reports", ("robot",), names)


def _memory(running: Iterable[Running]) -> Family:
    memory = Sums()
    for one in running:
        if one.observation and one.observation.memory_bytes is not None:
            labels = (one.record.robot, one.record.service, one.record.site or "")
            memory.add(labels, one.observation.memory_bytes)
    return gauge("instance_memory_bytes", "Resident memory", INSTANCE, memory)


def _promised(running: Iterable[Running]) -> Iterator[Family]:
    cores, memory = Sums(), Sums()
    for one in running:
        labels, held = (one.record.robot, one.record.service, one.record.site or ""), one.record.holds
        cores.add(labels, held.cpu)
        memory.add(labels, held.memory_mb * 2.0**20)
    yield gauge("instance_promised_cpu_cores", "Processors that are kept for it", INSTANCE, cores)
    yield gauge("instance_promised_memory_bytes", "Memory that is kept for it", INSTANCE, memory)


def _states(running: Iterable[Running]) -> Family:
    """Only what a manifest lists: no service makes up series."""
    states = Sums()
    for one in running:
        listed = one.record.spec.states
        said = [report.code for report in one.observation.reports if report.code in listed] if one.observation else []
        if said:
            states.add((one.record.robot, one.record.service, one.record.site or "", said[-1]), 1)
    return gauge("service_state", "1: the state that the service reported last", (*INSTANCE, "state"), states)


def _of_quotas(quotas: Quotas, running: Iterable[Running]) -> Iterator[Family]:
    count, cpu, memory, streams, limits = Sums(), Sums(), Sums(), Sums(), Sums()
    followed, data, there = Sums(), Sums(), Sums()
    for robot, size in quotas.data().items():
        data.put((robot,), size)
    for site, size in quotas.data_at().items():
        there.put((site,), size)
    by_robot = use_by_robot(one.record for one in running)
    for robot, n in (dict.fromkeys(by_robot, 0) | quotas.streams()).items():
        followed.put((robot,), n)
    for robot, use in by_robot.items():
        count.put((robot,), use.instances)
        cpu.put((robot,), use.cpu)
        memory.put((robot,), use.memory_mb * 2.0**20)
    for key, most in quotas.limits().items():
        limits.put((key,), most)
    streams.put((), quotas.open_streams)
    # From 0 on: the first refusal is an increase, too.
    refused = [((key,), n) for key, n in (dict.fromkeys(quotas.limits(), 0) | dict(quotas.refused)).items()]
    yield gauge("robot_instances", "Instances that have not ended", ("robot",), count)
    yield gauge("robot_promised_cpu_cores", "Processors that they asked for", ("robot",), cpu)
    yield gauge("robot_promised_memory_bytes", "Memory that they asked for", ("robot",), memory)
    yield gauge("robot_data_bytes", "Written by its services and left at sites", ("robot",), data)
    yield gauge("site_data_bytes", "Written by services and left there", ("site",), there)
    yield gauge("robot_open_streams", "Logs and events that it follows", ("robot",), followed)
    yield gauge("open_streams", "Logs and events that are followed", (), streams)
    yield gauge("quota_limit", "What one may have, in the unit of the setting", ("quota",), limits)
    yield counter("quota_refusals", "Requests refused because of a quota", ("quota",), refused)


def _sites(sites: Iterable[SiteGauges], running: Iterable[Running]) -> Iterator[Family]:
    up, cores, memory, load, promised, count = Sums(), Sums(), Sums(), Sums(), Sums(), Sums()
    for site in sites:
        labels = (site.name,)
        up.put(labels, float(site.capacity is not None))
        load.put(labels, site.load)
        if site.capacity is not None:
            cores.put(labels, site.capacity.cpu)
            memory.put(labels, site.capacity.memory_mb * 2.0**20)
        promised.put(labels, 0.0)
        count.put(labels, 0.0)
    for one in running:
        labels = (one.record.site or "",)
        if labels in up:
            promised.add(labels, one.record.holds.cpu)
            count.add(labels, 1)
    yield gauge("site_up", "1 while the site answers", ("site",), up)
    yield gauge("site_cpu_cores", "Processors of the site", ("site",), cores)
    yield gauge("site_memory_bytes", "Memory of the site", ("site",), memory)
    yield gauge("site_load_ratio", "Share of the site's processors that is busy", ("site",), load)
    yield gauge("site_promised_cpu_cores", "Processors that the instances there asked for", ("site",), promised)
    yield gauge("site_instances", "Instances there that have not ended", ("site",), count)


def _groups(groups: Iterable[GroupGauges]) -> Iterator[Family]:
    machines, most, failures = Sums(), Sums(), Sums()
    for group in groups:
        for stage in Stage:
            machines.put((group.name, stage.value), group.stages.count(stage))
        most.put((group.name,), group.most)
        failures.put((group.name,), group.failures)
    yield gauge("group_machines", "Machines of the group of sites", ("group", "stage"), machines)
    yield gauge("group_machines_limit", "Machines that the group may have", ("group",), most)
    yield gauge("group_failures", "Machines in a row that were not made, or did not become sites", ("group",), failures)


def _few(counts: Mapping[str, int]) -> dict[str, int]:
    """Of counts by reason, those whose reason can be a label, and not too many."""
    return dict([(reason, n) for reason, n in counts.items() if _REASON.fullmatch(reason)][:_MAX_REASONS])
