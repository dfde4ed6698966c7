"""A robot's report as Prometheus metrics: the same series at the robot's own ``/metrics`` and at the orchestrator's."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

from .exposition import Family, Sample, Sums, counter, gauge
from .rest import GateReport, Report

OUTCOMES = (
    "refused", "offered", "sent", "delivered", "lost", "late", "unknown", "expired", "replaced", "superseded",
    "duplicate",
)  # fmt: skip
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


def of_report(labels: Labels, report: Report) -> Iterator[Family]:
    """All that a robot has reported."""
    robot, service, _ = labels
    yield from gauges_of([(labels, report)])
    yield from gates_of({} if report.gate is None else {robot: report.gate})
    yield from counters_of({(robot, service): counts_of(report)})


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


def counters_of(accounts: Mapping[Owner, Counts], table: Mapping[str, Described] = COUNTERS) -> Iterator[Family]:
    """Those counters of robots' services that a table describes."""
    samples: dict[str, list[Sample]] = {name: [] for name in table}
    for owner, counts in accounts.items():
        for key, value in counts.items():
            if key[0] in samples:
                samples[key[0]].append(((*owner, *key[1:]), value))
    for name, described in table.items():
        if described.robots:
            yield counter(name, described.text, ("robot", *described.labels), _of_robots(samples[name]).items())
        else:
            yield counter(name, described.text, ("robot", "service", *described.labels), samples[name])


def _of_robots(samples: Iterable[Sample]) -> Sums:
    """Whatever the service."""
    sums = Sums()
    for (robot, _, *labels), value in samples:
        sums.add((robot, *labels), value)
    return sums


def gauges_of(reports: Iterable[tuple[Labels, Report]]) -> Iterator[Family]:
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


def gates_of(gates: Mapping[str, GateReport]) -> Iterator[Family]:
    """How robots' gates are, by robot."""
    up, stopped, troubles = Sums(), Sums(), Sums()
    for robot, gate in gates.items():
        up.put((robot,), float(gate.answers))
        stopped.put((robot,), float(bool(gate.stopped)))
        troubles.put((robot,), float(gate.troubles))
    yield gauge("gate_up", "1 while the gate before the robot's wheels answers", ("robot",), up)
    yield gauge("gate_stopped", "1 while the robot stands until a person resets it", ("robot",), stopped)
    yield gauge("gate_troubles", "What the gate says is wrong", ("robot",), troubles)
