from __future__ import annotations

import re
from collections.abc import Callable
from copy import deepcopy
from math import inf, nan
from typing import Any

import pytest

from skytether.api.groups import Stage
from skytether.api.report_metrics import counts_of
from skytether.api.rest import Refusal, Report, Size, TopicReport
from skytether.api.service_report import ServiceReport
from skytether.orchestrator.domain.counter_totals import CounterTotals, of_robot, of_run
from skytether.orchestrator.domain.records import Record
from skytether.orchestrator.runtimes.base import Capacity, Observation, Phase
from skytether.orchestrator.telemetry.metrics import GroupGauges, Metrics, Running, SiteGauges

NewRecord = Callable[..., Record]
ALLOWED = {
    "robot",
    "service",
    "topic",
    "priority",
    "site",
    "direction",
    "outcome",
    "source",
    "reason",
    "phase",
    "resource",
}
STANDARD = {"le", "quantile"}
"""Prometheus' own, of histograms and summaries."""


def record_with(new_record: NewRecord, manifest: Any, *topics: str, **changes: Any) -> Record:
    rows = [{"name": t, "type": "*" if t == "*" else "a/msg/B", "direction": "in", "priority": 100} for t in topics]
    return new_record(manifest=manifest(topics=rows), site="lab", **changes)


def reported(running: list[Running], max_topics: int = 64) -> tuple[Metrics, Callable[[Record, Report], None]]:
    """Metrics, and what takes a robot's report as the orchestrator does."""
    reports: dict[str, Report] = {}
    accounts: dict[tuple[str, str], CounterTotals] = {}
    metrics = Metrics(lambda: running, max_topics, reports=lambda: reports, accounts=lambda: deepcopy(accounts))

    def report(record: Record, told: Report) -> None:
        kept = reports[record.id] = metrics.bounded(record, told)
        accounts.setdefault((record.robot, record.service), CounterTotals()).merge(of_robot(told), counts_of(kept))

    return metrics, report


def topic(name: str = "scan", **more: Any) -> TopicReport:
    return TopicReport(topic=name, direction="in", priority=100, **more)


def test_every_name_and_label_is_one_of_the_architectures(new_record: NewRecord, manifest: Any) -> None:
    record = record_with(new_record, manifest, "scan")
    running = [
        Running(record, Observation(1, Phase.RUNNING, cpu_s=1.5, memory_bytes=1000, received_bytes=70, sent_bytes=30))
    ]
    metrics, report = reported(running)
    metrics.phase(record, "total", 0.4)
    metrics.refused("toy", [Refusal(site="far", reason="rtt", detail="")])
    metrics.resized(record, Size(cpu=1, memory_mb=1), Size(cpu=2, memory_mb=1), "busy")
    metrics.not_resized(record)
    report(
        record,
        Report(
            rtt_s=0.1,
            control_source="fallback",
            fallback_transitions={"delay": 2},
            topics=(
                topic(sent=9, delivered=7, lost=2, bytes_sent=900, delay_p50_s=0.05, delay_p99_s=0.2, jitter_s=0.01),
            ),
        ),
    )
    text = metrics.text().decode()
    names = set(re.findall(r"^# TYPE skytether_(\w+) ", text, re.MULTILINE))
    names -= {"instance_start_seconds_created", "renewal_seconds_created"}
    names -= {"instance_resizes_created", "instance_resize_failures_created"}
    assert {name for name in names if not name.startswith("site_")} - {"placement_refusals_created"} == {
        "renewal_seconds",
        "leader_epoch",
        "topic_one_way_delay_seconds",
        "path_rtt_seconds",
        "topic_messages_total",
        "topic_bytes_total",
        "topic_jitter_seconds",
        "control_source",
        "fallback_transitions_total",
        "control_objections_total",
        "control_overruns_total",
        "robot_load_ratio",
        "robot_battery_ratio",
        "gate_up",
        "gate_stopped",
        "gate_troubles",
        "robot_names",
        "instance_start_seconds",
        "instance_promised_cpu_cores",
        "instance_promised_memory_bytes",
        "instance_resizes_total",
        "instance_resize_failures_total",
        "instance_cpu_seconds_total",
        "instance_memory_bytes",
        "instance_restarts_total",
        "service_state",
        "instance_network_receive_bytes_total",
        "instance_network_transmit_bytes_total",
        "placement_refusals_total",
        "reconcile_pass_seconds",
        "group_machines",
        "group_machines_limit",
        "group_failures",
    }
    labels = set(re.findall(r"(\w+)=\"", text))
    assert labels <= ALLOWED | STANDARD
    one = 'direction="in",outcome="lost",priority="100",robot="walker",service="toy",topic="scan"'
    assert sample(text, "topic_messages_total", one) == 2
    assert sample(text, "control_source", 'robot="walker",service="toy",source="fallback"') == 1
    assert sample(text, "control_source", 'robot="walker",service="toy",source="cloud"') == 0
    assert sample(text, "instance_cpu_seconds_total", 'robot="walker",service="toy",site="lab"') == 1.5
    assert sample(text, "instance_network_receive_bytes_total", 'robot="walker",service="toy",site="lab"') == 70
    assert sample(text, "instance_network_transmit_bytes_total", 'robot="walker",service="toy",site="lab"') == 30
    where = 'direction="in",priority="100",quantile="0.99",robot="walker",service="toy",topic="scan"'
    assert sample(text, "topic_one_way_delay_seconds", where) == 0.2


def sample(text: str, name: str, labels: str) -> float | None:
    """A sample's value; labels in any order."""
    wanted = set(labels.split(","))
    for found, value in re.findall(rf"^skytether_{name}{{(.*)}} (\S+)$", text, re.MULTILINE):
        if set(found.split(",")) == wanted:
            return float(value)
    return None


def test_series_vanish_with_the_instance(new_record: NewRecord, manifest: Any) -> None:
    record = record_with(new_record, manifest, "scan")
    running = [Running(record, None)]
    metrics, report = reported(running)
    report(record, Report(rtt_s=0.1, topics=(topic(sent=1),), control_source="cloud"))
    assert 'robot="walker"' in metrics.text().decode()
    running.clear()
    assert 'robot="walker"' not in metrics.text().decode()


def test_series_vanish_with_the_site_and_the_service(new_record: NewRecord) -> None:
    metrics = Metrics(list, 64)
    metrics.phase(new_record(site="lab"), "total", 1)
    metrics.refused("toy", [Refusal(site="lab", reason="cpu", detail="")])
    metrics.forget_site("lab")
    assert 'site="lab"' not in metrics.text().decode()
    metrics.phase(new_record(site="lab"), "total", 1)
    metrics.refused("toy", [Refusal(site="lab", reason="cpu", detail="")])
    metrics.forget_service("toy")
    assert 'service="toy"' not in metrics.text().decode()


def test_the_state_that_a_service_reported_last_is_a_series_if_its_manifest_lists_it(
    new_record: NewRecord, manifest: Any
) -> None:
    record = new_record(site="lab", manifest=manifest(states=["following", "no_face"]))
    running = [Running(record, None)]
    metrics, _ = reported(running)

    def states(*codes: str) -> list[str]:
        said = tuple(ServiceReport(number, code, "") for number, code in enumerate(codes, start=1))
        running[:] = [Running(record, Observation(1, Phase.RUNNING, reports=said))]
        return re.findall(r'^skytether_service_state{.*state="(\w+)"} 1', metrics.text().decode(), re.MULTILINE)

    assert states() == []
    assert states("following") == ["following"]
    assert states("following", "no_face", "made_up") == ["no_face"]
    assert states(*(f"made_up_{n}" for n in range(8))) == []


def test_two_instances_of_one_robot_add_up(new_record: NewRecord, manifest: Any) -> None:
    records = [record_with(new_record, manifest, "scan", name=name) for name in ("a", "b")]
    metrics, report = reported([Running(r, Observation(1, Phase.RUNNING, memory_bytes=10)) for r in records])
    for record in records:  # of two programs on the robot
        report(record, Report(life=record.id, topics=(topic(sent=3, jitter_s=0.5),), rtt_s=0.2))
    text = metrics.text().decode()
    one = 'direction="in",outcome="sent",priority="100",robot="walker",service="toy",topic="scan"'
    assert sample(text, "topic_messages_total", one) == 6
    assert sample(text, "instance_memory_bytes", 'robot="walker",service="toy",site="lab"') == 20
    assert sample(text, "path_rtt_seconds", 'robot="walker",service="toy",site="lab"') == 0.2


def test_no_robot_can_blow_up_the_number_of_series(new_record: NewRecord, manifest: Any) -> None:
    fixed = record_with(new_record, manifest, "scan", name="a")
    wild = record_with(new_record, manifest, "*", name="b", robot="other")
    metrics, report = reported([Running(fixed, None), Running(wild, None)], max_topics=5)
    many = tuple(topic(f"t{n}") for n in range(1000))
    reasons = {'evil"\n': 1} | {f"reason_{n}": 1 for n in range(63)}
    for record in (fixed, wild):
        report(record, Report(topics=many, fallback_transitions=reasons, control_source="x" * 16))
    text = metrics.text().decode()
    assert 'robot="walker",service="toy",topic=' not in text
    assert len(set(re.findall(r'topic="(t\d+)"', text))) == 5
    assert len(re.findall(r"^skytether_fallback_transitions_total", text, re.MULTILINE)) == 64
    assert "evil" not in text
    assert "xxx" not in text


def test_no_robot_can_blow_it_up_in_the_course_of_time(new_record: NewRecord, manifest: Any) -> None:
    wild = record_with(new_record, manifest, "*")
    metrics, report = reported([Running(wild, None)], max_topics=20)
    for n in range(40):
        topics = tuple(topic(f"t{n}_{i}").model_copy(update={"priority": (n + i) % 128}) for i in range(20))
        report(wild, Report(life=f"life {n % 20}", topics=topics, fallback_transitions={f"reason_{n}": 1}))
    text = metrics.text().decode()
    names = set(re.findall(r'topic="(\w+)"', text)) | set(re.findall(r'reason="(\w+)"', text))
    assert len(names) == 256
    assert sample(text, "robot_names", 'robot="walker"') == 256
    assert set(re.findall(r'priority="(\d+)"', text)) == {str(wild.spec.topics[0].priority)}


def test_other_topics_with_each_renewal_make_no_series_without_end(new_record: NewRecord, manifest: Any) -> None:
    wild = record_with(new_record, manifest, "*")
    metrics, report = reported([Running(wild, None)])
    series: set[str] = set()
    for n in range(12):
        measured = {"delay_p50_s": 0.1, "delay_p99_s": 0.2, "jitter_s": 0.3}
        report(wild, Report(topics=tuple(topic(f"t{n}_{i}", **measured) for i in range(64))))
        series |= {line.rpartition(" ")[0] for line in metrics.text().decode().splitlines() if 'topic="' in line}
    assert len({name for one in series for name in re.findall(r'topic="(\w+)"', one)}) == 256
    assert len(series) == 256 * (11 + 1 + 3)


def test_numbers_that_nobody_can_have_measured_are_not_there(new_record: NewRecord, manifest: Any) -> None:
    record = record_with(new_record, manifest, "scan")
    metrics, report = reported([Running(record, None)])
    for wrong in (1e308, -1e308, nan, inf, -11.0, 3601.0):
        told = {"delay_p50_s": wrong, "delay_p99_s": wrong, "jitter_s": wrong}
        report(record, Report(rtt_s=wrong, load=wrong, battery=wrong, topics=(topic(**told),)))
        text = metrics.text().decode()
        for name in ("path_rtt", "robot_load", "robot_battery", "topic_one_way", "topic_jitter"):
            assert f"\nskytether_{name}" not in text, (name, wrong)
    with pytest.raises(ValueError, match="sent"):
        topic(sent=10**16)


def test_calls_are_reported_by_their_two_topics(new_record: NewRecord, manifest: Any) -> None:
    rows = [{"name": "plan", "kind": "call", "type": "nav_msgs/srv/GetPlan", "direction": "in"}]
    record = new_record(manifest=manifest(topics=rows), site="lab")
    metrics, report = reported([Running(record, None)])
    answer = TopicReport(topic="plan/response", direction="out", priority=0, delivered=3)
    report(record, Report(topics=(topic("plan/request", sent=3), answer, topic("plan/response", sent=9))))
    text = metrics.text().decode()
    assert set(re.findall(r'topic="(\S+?)"', text)) == {"plan/request", "plan/response"}
    where = 'direction="out",outcome="delivered",priority="64",robot="walker",service="toy",topic="plan/response"'
    assert sample(text, "topic_messages_total", where) == 3


def test_what_runs_used_and_how_often_they_began_anew_goes_on_over_restarts(new_record: NewRecord) -> None:
    where = 'robot="walker",service="toy",site="lab"'
    account = CounterTotals()
    running = [Running(new_record(site="lab"), Observation(1, Phase.RUNNING, cpu_s=5.0))]
    metrics = Metrics(lambda: running, 64, accounts=lambda: {("walker", "toy"): deepcopy(account)})

    def told() -> tuple[float | None, float | None]:
        text = metrics.text().decode()
        return sample(text, "instance_cpu_seconds_total", where), sample(text, "instance_restarts_total", where)

    assert told() == (5.0, 0.0)
    account.merge(*of_run(running[0].record, Observation(1, Phase.RUNNING, cpu_s=5.0)))  # noted, and still seen
    assert told() == (5.0, 0.0)
    running[0] = Running(new_record(site="lab", restarts=1, attempt=2), Observation(1, Phase.EXITED))
    assert told() == (5.0, 1.0)
    running[0] = Running(running[0].record, Observation(2, Phase.RUNNING, cpu_s=0.5))
    assert told() == (5.5, 1.0)
    running[0] = Running(new_record("i2", site="elsewhere"), Observation(1, Phase.RUNNING, cpu_s=0.25))
    assert told() == (None, None)  # of what is there no more
    running.append(Running(new_record("i3", site="lab"), None))
    assert told() == (5.0, 0.0)


def test_sites_tell_capacity_load_and_what_they_promised(new_record, manifest) -> None:
    running = [Running(record_with(new_record, manifest, "scan"), None)]
    gauges = [SiteGauges("lab", Capacity(4, 1024), 0.25), SiteGauges("gone", None, None)]
    text = Metrics(lambda: running, 64, lambda: gauges).text().decode()
    needs = running[0].record.spec.needs
    for line in (
        'skytether_site_up{site="lab"} 1.0',
        'skytether_site_up{site="gone"} 0.0',
        'skytether_site_cpu_cores{site="lab"} 4.0',
        'skytether_site_memory_bytes{site="lab"} 1.073741824e+09',
        'skytether_site_load_ratio{site="lab"} 0.25',
        f'skytether_site_promised_cpu_cores{{site="lab"}} {needs.cpu}',
        'skytether_site_instances{site="lab"} 1.0',
        'skytether_site_instances{site="gone"} 0.0',
    ):
        assert line in text.splitlines()
    assert 'skytether_site_cpu_cores{site="gone"}' not in text


def test_groups_of_sites_have_all_their_stages() -> None:
    gauges = [GroupGauges("cloud", 3, 1, [Stage.READY, Stage.READY, Stage.JOINING])]
    text = Metrics(list, 64, groups=lambda: gauges).text().decode()
    assert 'skytether_group_machines{group="cloud",stage="ready"} 2' in text
    assert 'skytether_group_machines{group="cloud",stage="joining"} 1' in text
    assert 'skytether_group_machines{group="cloud",stage="making"} 0' in text
    assert 'skytether_group_machines_limit{group="cloud"} 3' in text
    assert 'skytether_group_failures{group="cloud"} 1' in text
