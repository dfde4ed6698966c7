"""The text is, byte for byte, what Prometheus' own client library makes of the same samples."""

from __future__ import annotations

import math

import pytest
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.parser import text_string_to_metric_families
from prometheus_client.registry import Collector

from skytether.api.exposition import Family, Sums, counter, exposition, gauge

AWKWARD = (
    "",
    " ",
    "plain",
    'a "quoted" one',
    "back\\slash",
    "new\nline",
    '\\"\n\\n',
    "{a=b},%s",
    "größer ✓",
    "\r\t\x00",
)
NUMBERS = (0, -0.0, 1, 36_000, 0.1 + 0.2, -1e7, 999_999.5, 1e6, 80_000_000, 1_234_567.25, 2**53, 1e16, 1e22, 1e-7)
STRANGE = (math.inf, -math.inf, math.nan)


class _Given(Collector):
    def __init__(self, family: Metric) -> None:
        self._family = family

    def collect(self) -> list[Metric]:
        return [self._family]


def of_the_library(family: Family) -> bytes:
    kind = {"counter": CounterMetricFamily, "gauge": GaugeMetricFamily}[family.kind]
    theirs = kind(family.name, family.text, labels=family.labels)
    for labels, value in family.samples:
        theirs.add_metric(labels, value)
    registry = CollectorRegistry()
    registry.register(_Given(theirs))
    return generate_latest(registry)


@pytest.mark.parametrize(
    "family",
    [
        gauge("site_load_ratio", "Values", ("site",), {(value,): 0.5 for value in AWKWARD}),
        gauge("load", "Numbers", ("n",), {(str(n),): n for n in (*NUMBERS, *STRANGE)}),
        counter("used", "Numbers", ("n",), {(str(n),): n for n in NUMBERS}.items()),
        counter("messages", 'Not "one"\nline, \\ and all', ("topic", "b", "a"), [((v, "x", v), 1) for v in AWKWARD]),
        gauge("nothing", "No samples", ("a", "b"), {}),
    ],
    ids=lambda family: family.text[:8],
)
def test_lines_are_those_of_the_client_library(family: Family) -> None:
    assert exposition([family]) == of_the_library(family)


def test_families_follow_each_other_and_share_labels_but_not_names() -> None:
    families = [
        gauge("one", "One", ("site", "robot"), {("x", "y"): 1}),
        counter("two", "Two", ("robot", "site"), {("x", "y"): 1}.items()),
    ]
    assert exposition(families) == b"".join(map(of_the_library, families))
    assert exposition([]) == b""


def test_whoever_reads_it_finds_the_values_again() -> None:
    samples = Sums()
    for n, value in enumerate(AWKWARD):
        samples.put((value, "robot"), n)
    samples.put(("unknown", "robot"), None)
    samples.add(("plain", "robot"), 40)
    (found,) = text_string_to_metric_families(exposition([gauge("g", "G", ("topic", "robot"), samples)]).decode())
    told = {sample.labels["topic"]: sample.value for sample in found.samples}
    assert told == {value: n + 40 * (value == "plain") for n, value in enumerate(AWKWARD)}
