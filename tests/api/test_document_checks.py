from __future__ import annotations

import json
from datetime import date
from math import inf, nan
from typing import Any

import pytest

from skytether.api.document_checks import DEPTH, KEYS, LISTED_KEYS, oddity
from skytether.api.manifest import ServiceSpec, TopicSpec
from skytether.api.rest import MOST_TOPICS, Report, TopicReport


def nested(levels: int) -> Any:
    value: Any = 1
    for _ in range(levels):
        value = [value]
    return value


@pytest.mark.parametrize(
    "document", [{"a": [1, -1.5, True, None, "\u00e9 \U0001f4a5", {}], "": -(1 << 63)}, nested(DEPTH), 7, None]
)
def test_what_json_can_hold_is_left_alone(document: Any) -> None:
    assert oddity(document) is None


def test_as_many_topics_as_a_robot_and_a_service_may_have() -> None:
    """A robot of 256 topics could not renew: with all keys of each its report had more than a document might."""
    topic = TopicReport(topic="scan", direction="in", priority=1).model_dump()
    report = {"topics": [{**topic, "topic": f"scan{n}"} for n in range(MOST_TOPICS)]}
    assert (oddity({"report": report}), len(Report.model_validate(report).topics)) == (None, MOST_TOPICS)
    row = TopicSpec(name="scan", type="sensor_msgs/msg/LaserScan", direction="in").model_dump()
    spec = {"entrypoint": "toy.service", "topics": [{**row, "name": f"scan{n}"} for n in range(1000)]}
    assert (oddity({"spec": spec}), len(ServiceSpec.model_validate(spec).topics)) == (None, 1000)


def test_keys_are_bounded_in_lists_and_outside_of_them() -> None:
    assert oddity({str(n): {} for n in range(KEYS)} | {"0": [{"a": {"b": 1}}] * (LISTED_KEYS // 2)}) is None
    assert str(oddity({str(n): {} for n in range(KEYS + 1)})) == "has more than 4096 keys"
    assert str(oddity([{"a": {"b": 1}}] * (LISTED_KEYS // 2 + 1))) == "has more than 20000 keys in lists"


@pytest.mark.parametrize(
    ("document", "sentence"),
    [
        ({"a": {"b": [0, nan]}}, "a.b.1: must be a finite number, not nan"),
        ([-inf], "0: must be a finite number, not -inf"),
        ({"a": 1 << 63}, "a: must be a whole number of at most 64 bits"),
        ({"a": "x\0y"}, "a: holds a NUL character: leave it out"),
        ({"a": "\ud800"}, "a: holds half a character (a lone surrogate): leave it out"),
        ({"a": {"\udfff": 1}}, "a: one of its keys holds half a character (a lone surrogate): leave it out"),
        (nested(DEPTH + 1), "0.0.0: is nested more than 64 levels deep"),
        (nested(100_000), "0.0.0: is nested more than 64 levels deep"),
        (
            {"day": date(2026, 1, 2)},
            "day: must be text, a number, true or false, not datetime.date(2026, 1, 2); quote what is text",
        ),
    ],
)
def test_what_it_cannot_is_named(document: Any, sentence: str) -> None:
    assert str(oddity(document)) == sentence


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ('{"a": 1, "b": {"c:d": "e:f"}, "c": [{"a": ":"}]}', None),
        ('{"a": 1, "a": 1}', "a"),
        ('{"a": [{"b": {"c": 1, "\\u0063" : 2}}]}', "c"),
        ('{"a": {"b": 1}, "b": 2, "a": {}}', "a"),
        ('{"a": {"\\ud800": 1, "\\ud800": 2}, "a": 3}', "\\ud800"),
        ('{"' + "k" * 99 + '": 1, "' + "k" * 99 + '": 1}', "k" * 40),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_a_key_that_comes_twice(text: str, key: str | None, encoding: str) -> None:
    fault = oddity(json.loads(text), text.encode(encoding))
    assert str(fault) == (f"the key '{key}' comes twice: leave one of them out" if key else "None")
