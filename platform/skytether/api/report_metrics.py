"""A robot's report as Prometheus metrics: the same series at the robot's own ``/metrics`` and at the orchestrator's."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from .rest import Report

OUTCOMES = ("sent", "delivered", "lost", "late", "unknown", "expired", "replaced", "superseded", "duplicate")
SOURCES = ("cloud", "fallback", "stop")
INSTANCE = ("robot", "service", "site")
_TOPIC = ("topic", "priority", "direction")


class Described(NamedTuple):
    """A counter of a robot's service."""

    text: str
    labels: tuple[str, ...]
    """Beside robot and service."""
    robots: bool = False
    """It is the robot's, whatever the service."""


COUNTERS = {
    "topic_messages": Described("Messages by what became of them", (*_TOPIC, "outcome")),
    "topic_bytes": Described("Bytes sent, redundancy included", _TOPIC),
    "control_overruns": Described("Ticks of the control loop that came more than a period late", (), robots=True),
    "control_objections": Described("What the velocity supervisor found wrong with commands", ("objection",)),
    "fallback_transitions": Described("Hand-overs to the robot's own controller", ("reason",)),
}
"""What robots count."""

Labels = tuple[str, str, str]
"""Robot, service, site."""
Owner = tuple[str, str]
"""Robot, service."""
Counts = Mapping[tuple[str, ...], float]
"""Counters by metric and labels."""


class Sums(dict[tuple[str, ...], float]):
    """Samples by labels. A robot may hold two instances of one service: counts add up, and of gauges the last stays."""

    def add(self, labels: tuple[str, ...], value: float) -> None:
        """One more."""
        self[labels] = self.get(labels, 0.0) + value

    def put(self, labels: tuple[str, ...], value: float | None) -> None:
        """The value now, if it is known."""
        if value is not None:
            self[labels] = value


def gauge(name: str, text: str, labels: Iterable[str], samples: Mapping[tuple[str, ...], float]) -> Metric:
    """A gauge of ours with its samples."""
    family = GaugeMetricFamily(f"skytether_{name}", text, labels=list(labels))
    for key, value in samples.items():
        family.add_metric(key, value)
    return family


def counter(name: str, text: str, labels: Iterable[str], samples: Mapping[tuple[str, ...], float]) -> Metric:
    """A counter of ours with its samples."""
    family = CounterMetricFamily(f"skytether_{name}", text, labels=list(labels))
    for key, value in samples.items():
        family.add_metric(key, value)
    return family


def of_reports(reports: Sequence[tuple[Labels, Report]]) -> Iterator[Metric]:
    """All that robots have reported."""
    yield from gauges_of(reports)
    yield from counters_of([((labels[0], labels[1]), counts_of(report)) for labels, report in reports])


def counts_of(report: Report) -> dict[tuple[str, ...], float]:
    """The counters of a report, by metric and labels."""
    counts: dict[tuple[str, ...], float] = {}
    for topic in report.topics:
        labels = (topic.topic, str(topic.priority), topic.direction)
        counts["topic_bytes", *labels] = topic.bytes_sent
        for outcome in OUTCOMES:
            counts["topic_messages", *labels, outcome] = getattr(topic, outcome)
    counts |= {("fallback_transitions", reason): n for reason, n in report.fallback_transitions.items()}
    counts |= {("control_objections", objection): n for objection, n in report.objections.items()}
    if report.overruns is not None:
        counts["control_overruns",] = report.overruns
    return counts


def counters_of(
    accounts: Iterable[tuple[Owner, Counts]], table: Mapping[str, Described] = COUNTERS
) -> Iterator[Metric]:
    """Those counters of robots' services that a table describes."""
    sums = {name: Sums() for name in table}
    for (robot, service), counts in accounts:
        for (name, *labels), value in counts.items():
            if name in sums:
                sums[name].add((robot, *labels) if table[name].robots else (robot, service, *labels), value)
    for name, described in table.items():
        owner = ("robot",) if described.robots else ("robot", "service")
        yield counter(name, described.text, (*owner, *described.labels), sums[name])


def gauges_of(reports: Iterable[tuple[Labels, Report]]) -> Iterator[Metric]:
    """What is so now."""
    rtt, source, load, battery, delay, jitter = Sums(), Sums(), Sums(), Sums(), Sums(), Sums()
    for (robot, service, site), report in reports:
        rtt.put((robot, service, site), report.rtt_s)
        if report.control_source in SOURCES:
            for name in SOURCES:
                source.put((robot, service, name), float(name == report.control_source))
        load.put((robot,), report.load)
        battery.put((robot,), report.battery)
        for topic in report.topics:
            labels = (robot, service, topic.topic, str(topic.priority), topic.direction)
            delay.put((*labels, "0.5"), topic.delay_p50_s)
            delay.put((*labels, "0.99"), topic.delay_p99_s)
            jitter.put(labels, topic.jitter_s)
    yield gauge("path_rtt_seconds", "Round trip between robot and service", INSTANCE, rtt)
    yield gauge("robot_load_ratio", "Share of the robot's processors that is busy", ("robot",), load)
    yield gauge("robot_battery_ratio", "Charge of the robot's battery", ("robot",), battery)
    yield gauge("control_source", "1 for who drives, 0 for who does not", ("robot", "service", "source"), source)
    labelled = ("robot", "service", *_TOPIC)
    yield gauge("topic_one_way_delay_seconds", "From publish to delivery", (*labelled, "quantile"), delay)
    yield gauge("topic_jitter_seconds", "Mean difference of successive delays", labelled, jitter)
