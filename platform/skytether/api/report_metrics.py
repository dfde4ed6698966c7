"""A robot's report as Prometheus metrics: the same series at the robot's own ``/metrics`` and at the orchestrator's."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from .rest import Report, TopicReport

OUTCOMES = ("sent", "delivered", "lost", "late", "expired", "replaced", "superseded", "duplicate")
SOURCES = ("cloud", "fallback", "stop")
INSTANCE = ("robot", "service", "site")
_TOPIC = ("robot", "service", "topic", "priority", "direction")

Labels = tuple[str, str, str]
"""Robot, service, site."""


class Sums(dict[tuple[str, ...], float]):
    """Samples by labels. A robot may hold two instances of one service: counts add up, and of gauges the last stays."""

    def add(self, labels: Iterable[object], value: float) -> None:
        """One more."""
        key = tuple(str(label) for label in labels)
        self[key] = self.get(key, 0.0) + value

    def put(self, labels: Iterable[object], value: float | None) -> None:
        """The value now, if it is known."""
        if value is not None:
            self[tuple(str(label) for label in labels)] = value


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
    yield from _control(reports)
    yield from _topics([(labels, topic) for labels, report in reports for topic in report.topics])


def _control(reports: Iterable[tuple[Labels, Report]]) -> Iterator[Metric]:
    rtt, source, transitions, objections = Sums(), Sums(), Sums(), Sums()
    load, battery, overruns = Sums(), Sums(), Sums()
    for (robot, service, site), report in reports:
        rtt.put((robot, service, site), report.rtt_s)
        if report.control_source in SOURCES:
            for name in SOURCES:
                source.put((robot, service, name), float(name == report.control_source))
        for reason, count in report.fallback_transitions.items():
            transitions.add((robot, service, reason), count)
        for objection, count in report.objections.items():
            objections.add((robot, service, objection), count)
        load.put((robot,), report.load)
        battery.put((robot,), report.battery)
        overruns.put((robot,), report.overruns)
    yield gauge("path_rtt_seconds", "Round trip between robot and service", INSTANCE, rtt)
    yield gauge("robot_load_ratio", "Share of the robot's processors that is busy", ("robot",), load)
    yield gauge("robot_battery_ratio", "Charge of the robot's battery", ("robot",), battery)
    yield counter(
        "control_overruns", "Ticks of the control loop that came more than a period late", ("robot",), overruns
    )
    labels = ("robot", "service", "objection")
    yield counter("control_objections", "What the velocity supervisor found wrong with commands", labels, objections)
    yield gauge("control_source", "1 for who drives, 0 for who does not", ("robot", "service", "source"), source)
    labels = ("robot", "service", "reason")
    yield counter("fallback_transitions", "Hand-overs to the robot's own controller", labels, transitions)


def _topics(topics: Iterable[tuple[Labels, TopicReport]]) -> Iterator[Metric]:
    delay, jitter, messages, sent = Sums(), Sums(), Sums(), Sums()
    for (robot, service, _), topic in topics:
        labels = (robot, service, topic.topic, topic.priority, topic.direction)
        delay.put((*labels, "0.5"), topic.delay_p50_s)
        delay.put((*labels, "0.99"), topic.delay_p99_s)
        jitter.put(labels, topic.jitter_s)
        sent.add(labels, topic.bytes_sent)
        for outcome in OUTCOMES:
            messages.add((*labels, outcome), getattr(topic, outcome))
    yield gauge("topic_one_way_delay_seconds", "From publish to delivery", (*_TOPIC, "quantile"), delay)
    yield gauge("topic_jitter_seconds", "Mean difference of successive delays", _TOPIC, jitter)
    yield counter("topic_messages", "Messages of the present session", (*_TOPIC, "outcome"), messages)
    yield counter("topic_bytes", "Bytes sent, redundancy included", _TOPIC, sent)
