"""What Prometheus gets. Series exist while what they describe exists; labels never hold an id.

The robot's end of the bridge knows both directions, so topics come from the robots' reports, which arrive with each
renewal, at any of several orchestrators; the one that leads exports them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from skytether.api.manifest import ANY_TOPIC
from skytether.api.rest import Refusal, Report, TopicReport

from .records import Record
from .runtimes.base import Capacity, Observation

OUTCOMES = ("sent", "delivered", "lost", "late", "expired", "replaced", "superseded", "duplicate")
SOURCES = ("cloud", "fallback", "stop")
_REASON = re.compile(r"[a-z][a-z0-9_-]{0,39}")
_MAX_REASONS = 32
_BUCKETS = (0.01, 0.025, 0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 2.0, 5.0, 10.0, 30.0)
_TOPIC = ("robot", "service", "topic", "priority", "direction")
_INSTANCE = ("robot", "service", "site")


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


class Metrics(Collector):
    """The registry of one orchestrator, and what feeds it."""

    def __init__(
        self,
        running: Callable[[], Iterable[Running]],
        max_topics: int,
        sites: Callable[[], Iterable[SiteGauges]] = tuple,
        reports: Callable[[], Mapping[str, Report]] = dict,
    ) -> None:
        """All callables are asked at each scrape.

        Args:
            running: What has not ended.
            max_topics: Bounds the topics of a robot's report.
            sites: What is known of the sites.
            reports: The last report on each instance, as ``bounded`` left it.
        """
        self._running = running
        self._sites = sites
        self._reports = reports
        self._max_topics = max_topics
        self._registry = CollectorRegistry()
        self._start = Histogram(
            "skytether_instance_start_seconds",
            "From request to placed (placing), from launch to ready (starting), from request to ready (total)",
            ("service", "site", "phase"),
            buckets=_BUCKETS,
            registry=self._registry,
        )
        self._refusals = Counter(
            "skytether_placement_refusals",
            "Sites refused in placement",
            ("service", "site", "reason"),
            registry=self._registry,
        )
        self._registry.register(self)

    def text(self) -> bytes:
        """In Prometheus' text format."""
        return generate_latest(self._registry)

    def phase(self, record: Record, phase: str, seconds: float) -> None:
        """One part of an instance's start; a clock that was set back gives no negative ones."""
        self._start.labels(record.service, record.site or "", phase).observe(max(0.0, seconds))

    def refused(self, service: str, refusals: Iterable[Refusal]) -> None:
        for refusal in refusals:
            self._refusals.labels(service, refusal.site, refusal.reason).inc()

    def bounded(self, record: Record, report: Report) -> Report:
        """A robot's report on one instance, without what would make series that nobody declared."""
        known = {topic.name for topic in record.spec.topics}
        topics = [t for t in report.topics if t.topic in known or ANY_TOPIC in known][: self._max_topics]
        reasons = {r: n for r, n in report.fallback_transitions.items() if _REASON.fullmatch(r)}
        bounded = dict(list(reasons.items())[:_MAX_REASONS])
        return report.model_copy(update={"topics": tuple(topics), "fallback_transitions": bounded})

    def forget_site(self, site: str) -> None:
        self._start.remove_by_labels({"site": site})
        self._refusals.remove_by_labels({"site": site})

    def forget_service(self, service: str) -> None:
        self._start.remove_by_labels({"service": service})
        self._refusals.remove_by_labels({"service": service})

    def describe(self) -> Iterable[Metric]:
        """Nothing: the registry would otherwise collect once at registration."""
        return ()

    def collect(self) -> Iterator[Metric]:
        running = list(self._running())
        known = self._reports()
        reports = [(r.record, known[r.record.id]) for r in running if r.record.id in known]
        yield from _instances(running)
        yield from _sites(self._sites(), running)
        yield from _control(reports)
        yield from _topics([(record, topic) for record, report in reports for topic in report.topics])


class _Sums(dict[tuple[str, ...], float]):
    """Samples by labels. A robot may hold two instances of one service: counts add up, and of gauges the last stays."""

    def add(self, labels: Iterable[object], value: float) -> None:
        key = tuple(str(label) for label in labels)
        self[key] = self.get(key, 0.0) + value

    def put(self, labels: Iterable[object], value: float | None) -> None:
        if value is not None:
            self[tuple(str(label) for label in labels)] = value


def _gauge(name: str, text: str, labels: Iterable[str], samples: Mapping[tuple[str, ...], float]) -> Metric:
    family = GaugeMetricFamily(f"skytether_{name}", text, labels=list(labels))
    for key, value in samples.items():
        family.add_metric(key, value)
    return family


def _counter(name: str, text: str, labels: Iterable[str], samples: Mapping[tuple[str, ...], float]) -> Metric:
    family = CounterMetricFamily(f"skytether_{name}", text, labels=list(labels))
    for key, value in samples.items():
        family.add_metric(key, value)
    return family


def _instances(running: Iterable[Running]) -> Iterator[Metric]:
    cpu, memory = _Sums(), _Sums()
    for one in running:
        labels = (one.record.robot, one.record.service, one.record.site or "")
        if one.observation and one.observation.cpu_s is not None:
            cpu.add(labels, one.observation.cpu_s)
        if one.observation and one.observation.memory_bytes is not None:
            memory.add(labels, one.observation.memory_bytes)
    yield _counter("instance_cpu_seconds", "Processor time of the present runs", _INSTANCE, cpu)
    yield _gauge("instance_memory_bytes", "Resident memory", _INSTANCE, memory)


def _sites(sites: Iterable[SiteGauges], running: Iterable[Running]) -> Iterator[Metric]:
    up, cores, memory, load, promised, count = _Sums(), _Sums(), _Sums(), _Sums(), _Sums(), _Sums()
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
        if (one.record.site or "",) in up:
            promised.add((one.record.site,), one.record.spec.needs.cpu)
            count.add((one.record.site,), 1)
    yield _gauge("site_up", "1 while the site answers", ("site",), up)
    yield _gauge("site_cpu_cores", "Processors of the site", ("site",), cores)
    yield _gauge("site_memory_bytes", "Memory of the site", ("site",), memory)
    yield _gauge("site_load_ratio", "Share of the site's processors that is busy", ("site",), load)
    yield _gauge("site_promised_cpu_cores", "Processors that the instances there asked for", ("site",), promised)
    yield _gauge("site_instances", "Instances there that have not ended", ("site",), count)


def _control(reports: Iterable[tuple[Record, Report]]) -> Iterator[Metric]:
    rtt, source, transitions = _Sums(), _Sums(), _Sums()
    for record, report in reports:
        rtt.put((record.robot, record.service, record.site or ""), report.rtt_s)
        if report.control_source in SOURCES:
            for name in SOURCES:
                source.put((record.robot, record.service, name), float(name == report.control_source))
        for reason, count in report.fallback_transitions.items():
            transitions.add((record.robot, record.service, reason), count)
    yield _gauge("path_rtt_seconds", "Round trip between robot and service", _INSTANCE, rtt)
    yield _gauge("control_source", "1 for who drives, 0 for who does not", ("robot", "service", "source"), source)
    labels = ("robot", "service", "reason")
    yield _counter("fallback_transitions", "Hand-overs to the robot's own controller", labels, transitions)


def _topics(topics: Iterable[tuple[Record, TopicReport]]) -> Iterator[Metric]:
    delay, jitter, messages, sent = _Sums(), _Sums(), _Sums(), _Sums()
    for record, topic in topics:
        labels = (record.robot, record.service, topic.topic, topic.priority, topic.direction)
        delay.put((*labels, "0.5"), topic.delay_p50_s)
        delay.put((*labels, "0.99"), topic.delay_p99_s)
        jitter.put(labels, topic.jitter_s)
        sent.add(labels, topic.bytes_sent)
        for outcome in OUTCOMES:
            messages.add((*labels, outcome), getattr(topic, outcome))
    yield _gauge("topic_one_way_delay_seconds", "From publish to delivery", (*_TOPIC, "quantile"), delay)
    yield _gauge("topic_jitter_seconds", "Mean difference of successive delays", _TOPIC, jitter)
    yield _counter("topic_messages", "Messages of the present session", (*_TOPIC, "outcome"), messages)
    yield _counter("topic_bytes", "Bytes sent, redundancy included", _TOPIC, sent)
