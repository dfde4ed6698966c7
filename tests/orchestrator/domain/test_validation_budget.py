"""Checks of parameters end soon, whatever a manifest's schema says."""

from __future__ import annotations

from typing import Any

import pytest
from jsonschema import Draft202012Validator

from skytether.orchestrator.domain.errors import InvalidError
from skytether.orchestrator.domain.validation import check_params, check_schema
from skytether.orchestrator.domain.validation_budget import BudgetError, bounded

LEVELS = 16
"""2 ** 16 steps and more: a second without a bound. An attacker takes 30."""


def doubling(how: str, last: Any) -> dict[str, Any]:
    """A schema of definitions that refer to the next one twice."""
    twice: dict[int, Any] = {level: [{"$ref": f"#/$defs/d{level + 1}"}] * 2 for level in range(LEVELS)}
    return {"$defs": {f"d{level}": {how: both} for level, both in twice.items()} | {f"d{LEVELS}": last}}


def nested(levels: int) -> Any:
    return {"a": nested(levels - 1)} if levels else 1


ITSELF_TWICE = {"properties": {"a": {"anyOf": [{"$ref": "#"}, {"$ref": "#"}]}}, "required": ["b"]}
WRONG = {"type": "array"}
MANY = 4_000
SOME = 400

ENDLESS: dict[str, tuple[Any, Any]] = {
    "allOf": ({**doubling("allOf", {"type": "object"}), "$ref": "#/$defs/d0"}, {"a": 1}),
    "anyOf": ({**doubling("anyOf", WRONG), "$ref": "#/$defs/d0"}, {"a": 1}),
    "oneOf": ({**doubling("oneOf", WRONG), "properties": {"a": {"$ref": "#/$defs/d0"}}}, {"a": 1}),
    "itself": (ITSELF_TWICE, nested(LEVELS)),
    "errors": ({"allOf": [{"properties": {"a": WRONG}}] * 400}, {"a": "a" * 200_000}),
    "enum": ({"properties": {"a": {"items": {"enum": [[n] for n in range(MANY)]}}}}, {"a": [[0]] * 100 + [1] * MANY}),
    "patterns": ({"patternProperties": {f"^{n}$": {} for n in range(SOME)}}, {f"a{n}": 1 for n in range(MANY)}),
    "known": (
        {"properties": {"a": {"patternProperties": {f"^{n}$": {} for n in range(SOME)}, "additionalProperties": {}}}},
        {"a": {f"a{n}": 1 for n in range(MANY)}},
    ),
    "contains": ({"properties": {"a": {"allOf": [{"contains": {}}] * 100}}}, {"a": [1] * 10_000}),
    "required": ({"allOf": [{"required": ["a"] * 4_000}] * 4}, {"a": 1}),
}


@pytest.mark.parametrize("name", ENDLESS)
def test_a_check_ends_however_often_the_schema_refers_to_what_it_has(name: str) -> None:
    schema, params = ENDLESS[name]
    schema = {"additionalProperties": True, **schema}
    if name != "required":  # equal names in one list are no schema, but an old manifest may have it
        check_schema(schema, "spec.params")
    with pytest.raises(InvalidError, match=r"service 's': params: take more than \d+ steps to check: give fewer"):
        check_params(params, schema, "s")


POSES = {
    "type": "object",
    "$defs": {
        "pose": {
            "type": "object",
            "additionalProperties": False,
            "required": ["x", "y"],
            "properties": {key: {"type": "number", "minimum": -1e4, "maximum": 1e4} for key in ("x", "y", "yaw")},
        }
    },
    "properties": {
        "start": {"anyOf": [{"$ref": "#/$defs/pose"}, {"type": "null"}]},
        "goals": {"type": "array", "maxItems": 9_000, "items": {"$ref": "#/$defs/pose"}},
        "ranges": {"type": "array", "items": {"type": "number", "minimum": 0, "maximum": 100, "multipleOf": 0.5}},
        "names": {"type": "array", "uniqueItems": True, "items": {"type": "string", "pattern": "^[a-z0-9]+$"}},
    },
}


def test_what_people_ask_for_is_far_within() -> None:
    pose = {"x": 1.0, "y": 2.0, "yaw": 0.5}
    check_schema(POSES, "spec.params")
    check_params({"start": pose, "goals": [pose] * 600}, POSES, "s")
    check_params({"start": None, "ranges": [0.5] * 2_000}, POSES, "s")
    check_params({"names": [f"n{n}" for n in range(2_000)]}, POSES, "s")
    with pytest.raises(InvalidError, match=r"params\.goals\.599\.yaw: 'a' is not of type 'number'"):
        check_params({"goals": [pose] * 599 + [{**pose, "yaw": "a"}]}, POSES, "s")


@pytest.mark.parametrize(
    "items",
    [
        *([{"a": 1, "b": 2}, {"b": 2, "a": 1}], [{"a": 1}, ["a", 1]], [None, "None"], [None, None], [[], {}]),
        *(
            [],
            [1, 2],
            [1, 1.0],
            [1, True],
            [0, False],
            [[1], [True]],
            [[1], [1.0]],
            [{"a": [1]}, {"a": [1.0]}],
            ["1", 1],
        ),
    ],
)
def test_equal_items_are_found_as_the_library_finds_them(items: list[Any]) -> None:
    schema = {"properties": {"a": {"uniqueItems": True}}}
    if Draft202012Validator(schema).is_valid({"a": items}):
        check_params({"a": items}, schema, "s")
    else:
        with pytest.raises(InvalidError, match=r"params\.a: .* has items that are equal"):
            check_params({"a": items}, schema, "s")


def test_items_of_many_kinds_are_compared_once_each() -> None:
    """Each beside each takes minutes."""
    kinds = [{"x": n} if n % 2 else [n] for n in range(15_000)]  # which cannot be sorted
    check_params({"a": kinds}, {"properties": {"a": {"uniqueItems": True}}}, "s")
    with pytest.raises(InvalidError, match=r"spec\.params\.type: "):
        check_schema({"type": kinds[:4_000] * 2}, "spec.params")


def test_a_name_is_looked_for_once() -> None:
    """To look through the schema for each takes a minute."""
    schema = {"$defs": {f"d{n}": {"$anchor": f"a{n}"} for n in range(900)}, "additionalProperties": {"$ref": "#a9"}}
    check_schema({**schema, "allOf": [{"$ref": f"#a{n}"} for n in range(900)]}, "spec.params")
    check_params({f"p{n}": n for n in range(900)}, schema, "s")


@pytest.mark.parametrize("dialect", ["https://json-schema.org/draft/2020-12/schema", "http://json-schema.org/schema#"])
def test_no_part_of_a_schema_is_checked_by_other_rules(dialect: str) -> None:
    """Python's own patterns take 2 ** 36 steps for this one."""
    schema = {"properties": {"a": {"$schema": dialect, "pattern": "^(a+)+$"}}}
    check_schema(schema, "spec.params")
    with pytest.raises(InvalidError, match="does not match"):
        check_params({"a": "a" * 36 + "!"}, schema, "s")
    old = {"properties": {"a": {"$schema": dialect, "pattern": "(?=a)"}}}
    with pytest.raises(InvalidError, match=r"no pattern that can be used .* correct the manifest"):
        check_params({"a": "a"}, old, "s")


@pytest.mark.parametrize("keyword", ["unevaluatedProperties", "unevaluatedItems"])
def test_what_looks_through_a_schema_in_a_way_of_its_own_is_not_taken(keyword: str) -> None:
    schema = {"properties": {"a": {keyword: False}}}
    with pytest.raises(InvalidError, match=rf"spec\.params\.properties\.a\.{keyword}: cannot be used; write "):
        check_schema(schema, "spec.params")
    with pytest.raises(InvalidError, match=f"'{keyword}' cannot be used; write .*: correct the manifest"):
        check_params({"a": {}}, schema, "s")
    check_schema({"properties": {keyword: {"type": "number"}}}, "spec.params")
    check_params({keyword: 1}, {"properties": {keyword: {"type": "number"}}}, "s")


@pytest.mark.parametrize("schema", [{"$id": "http://[", "$defs": {"a": {"$id": "b"}}}, {"$ref": "http://["}])
def test_what_is_no_address_is_said(schema: dict[str, Any]) -> None:
    with pytest.raises(InvalidError, match=r"is no address|there is no 'http://\['"):
        check_schema(schema, "spec.params")
    with pytest.raises(InvalidError, match=r"is no address|cannot resolve the reference"):
        check_params({}, schema, "s")


def test_a_bound_ends_with_what_it_is_for() -> None:
    large = {"allOf": [{"type": "object"}] * 1_000}
    with pytest.raises(BudgetError), bounded({}):
        check_schema(large, "spec.params")
    check_schema(large, "spec.params")
