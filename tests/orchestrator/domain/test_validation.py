from __future__ import annotations

from typing import Any

import pytest
from jsonschema import Draft202012Validator

from skytether.api.manifest import Manifest
from skytether.orchestrator.domain.errors import InvalidError
from skytether.orchestrator.domain.validation import check_params, check_schema, parse

SCHEMA = {
    "type": "object",
    "required": ["trail"],
    "properties": {
        "mass": {"type": "number", "exclusiveMinimum": 0},
        "trail": {
            "type": "array",
            "items": {"type": "object", "properties": {"length": {}, "radius": {}}, "additionalProperties": False},
        },
    },
}


def told(model: Any, document: Any, **more: Any) -> str:
    with pytest.raises(InvalidError) as caught:
        parse(model, document, **more)
    return str(caught.value)


def test_a_typo_deep_in_a_manifest_names_the_key_and_the_nearest(manifest: Any) -> None:
    document = manifest(topics=[{"name": "a", "type": "b", "direction": "in", "prority": 3}])
    assert told(Manifest, document) == "spec.topics.0.prority: unknown key, did you mean 'priority'?"


def test_an_unknown_key_far_from_all_names_all(manifest: Any) -> None:
    text = told(Manifest, manifest(needs={"zzz": 1}))
    known = (
        "architectures, compute_ms, cpu, devices, egress, gpu, max_loss, max_rtt_ms, memory_mb, scaling, standby, tiers"
    )
    assert text == f"spec.needs.zzz: unknown key; known are {known}"


def test_an_unknown_key_at_the_top_and_a_missing_one(manifest: Any) -> None:
    document = manifest()
    del document["metadata"]
    document["spce"] = {}
    text = told(Manifest, document, what="my.yaml")
    assert text == "my.yaml: metadata: is missing; spce: unknown key, did you mean 'spec'?"


def test_a_wrong_value_and_a_models_own_check(manifest: Any) -> None:
    assert told(Manifest, manifest(needs={"cpu": -1})) == "spec.needs.cpu: input should be greater than 0"
    assert "topic 'a' is listed twice" in told(
        Manifest, manifest(topics=[{"name": "a", "type": "b", "direction": "in"}] * 2)
    )
    assert told(Manifest, 7) == "must be a mapping of keys to values"


@pytest.mark.parametrize(
    ("params", "text"),
    [
        ({}, "params.trail: is missing"),
        ({"trail": [], "mas": 1}, "params.mas: unknown key, did you mean 'mass'?"),
        ({"trail": [], "mass": 0}, "params.mass: 0 is less than or equal to the minimum of 0"),
        ({"trail": [], "mass": "8"}, "params.mass: '8' is not of type 'number'"),
        ({"trail": [{"lenght": 1}]}, "params.trail.0.lenght: unknown key, did you mean 'length'?"),
    ],
)
def test_wrong_parameters_name_the_key(params: dict[str, Any], text: str) -> None:
    with pytest.raises(InvalidError) as caught:
        check_params(params, SCHEMA, "virtual-trail")
    assert str(caught.value) == f"service 'virtual-trail': {text}"
    assert len(caught.value.faults) == 1


def test_right_parameters_pass_and_a_schema_may_allow_unknown_ones() -> None:
    check_params({"trail": [{"length": 2}], "mass": 3}, SCHEMA, "s")
    check_params({"anything": 1}, {"additionalProperties": True}, "s")
    with pytest.raises(InvalidError, match="there are none"):
        check_params({"anything": 1}, {}, "s")


def test_keys_that_match_a_pattern_are_known() -> None:
    schema = {"patternProperties": {"^x": {}}, "additionalProperties": False}
    check_params({"xyz": 1}, schema, "s")
    with pytest.raises(InvalidError, match=r"params: .*'abc'"):
        check_params({"abc": 1, "xyz": 1}, schema, "s")


def test_a_reference_to_somewhere_else_is_not_fetched() -> None:
    with pytest.raises(InvalidError, match=r"cannot resolve the reference http://127\.0\.0\.1:1/s\.json"):
        check_params({"a": 1}, {"properties": {"a": {"$ref": "http://127.0.0.1:1/s.json"}}}, "s")


def test_a_schema_that_is_none_names_the_key() -> None:
    with pytest.raises(InvalidError) as caught:
        check_schema({"properties": {"mass": {"type": "nmber"}}}, "spec.params")
    assert caught.value.faults[0].key == "spec.params.properties.mass.type"


@pytest.mark.parametrize("reference", ["#/nope", "http://127.0.0.1:1/s.json", "#nothing"])
def test_a_reference_to_nothing_names_the_key(reference: str) -> None:
    check_schema({"properties": {"a": {"$ref": "#/$defs/b"}}, "$defs": {"b": {"$anchor": "c"}}, "$ref": "#c"}, "p")
    with pytest.raises(InvalidError) as caught:
        check_schema({"properties": {"a": {"$ref": reference}}}, "spec.params")
    text = f"there is no '{reference}' in this schema, and nothing is fetched from elsewhere"
    assert str(caught.value) == f"spec.params.properties.a.$ref: {text}"


def test_a_schema_that_refers_to_itself_without_end_is_refused() -> None:
    with pytest.raises(InvalidError, match=r"s: spec\.params: the schema refers to itself without end"):
        check_params({"a": 1}, {"$ref": "#"}, "s")


EVIL = ("^(a+)+$", "(a|a)*$", "^(([a-z])+.)+[A-Z]([a-z])+$", "(.*a){12}$", "a*a*a*a*a*a*a*a*a*$")
"""Each takes Python's engine longer than a test runs for a text of a few dozen letters."""


@pytest.mark.parametrize("pattern", EVIL)
def test_a_pattern_takes_time_as_its_text_is_long_and_no_more(pattern: str) -> None:
    text = "a" * 20_000 + "!"
    schema = {
        "properties": {"name": {"pattern": pattern}, "more": {"patternProperties": {pattern: False}}},
        "patternProperties": {pattern: {"type": "integer"}},
    }
    check_schema(schema, "spec.params")
    params: dict[str, Any] = {"name": text, "more": {text: 1}, text: "x"}
    with pytest.raises(InvalidError) as caught:
        check_params(params, schema, "s")
    assert "params.name: " in str(caught.value)


@pytest.mark.parametrize(
    ("params", "wrong"),
    [
        ({"id-7": 1, "name": "ab"}, ""),
        ({"id-7": "x"}, "params.id-7: 'x' is not of type 'integer'"),
        ({"name": "7"}, "params.name: '7' does not match '^[a-z]+$'"),
        ({"other": 1}, "additional keys are not allowed: 'other'"),
        ({"deep": {"x1": 1, "y": 2}}, ""),
        ({"deep": {"y": "z"}}, "params.deep.y: 'z' is not of type 'integer'"),
        ({"deep": 3, "name": 4}, ""),
    ],
)
def test_patterns_mean_what_they_always_did(params: dict[str, Any], wrong: str) -> None:
    schema = {
        "properties": {
            "name": {"pattern": "^[a-z]+$"},
            "deep": {"patternProperties": {"^x": {}}, "additionalProperties": {"type": "integer"}},
        },
        "patternProperties": {r"^id-\d+$": {"type": "integer"}},
    }
    check_schema(schema, "spec.params")
    # What the keywords of the library say of the same, but for the words.
    assert (not wrong) is Draft202012Validator({"additionalProperties": False, **schema}).is_valid(params)
    if not wrong:
        check_params(params, schema, "s")
        return
    with pytest.raises(InvalidError) as caught:
        check_params(params, schema, "s")
    assert wrong in str(caught.value)


@pytest.mark.parametrize(
    ("schema", "text"),
    [
        ({"properties": {"a": {"pattern": "(?=a)b"}}}, r"spec.params.properties.a.pattern: '(?=a)b' is no pattern"),
        ({"properties": {"a": {"pattern": r"(a)\1"}}}, "neither ahead nor behind"),
        ({"patternProperties": {"(?<!a)b": {}}}, "spec.params.patternProperties: '(?<!a)b' is no pattern"),
        ({"items": {"pattern": "a" * 1025}}, "has 1025 characters: at most 1024 can be used"),
        ({"properties": {"a": {"pattern": "((a{100}){100}){100}"}}}, "is no pattern that can be used"),
        ({"patternProperties": {"a": {}}, "unevaluatedProperties": False}, "write additionalProperties"),
    ],
)
def test_a_pattern_that_cannot_be_used_is_named_when_the_manifest_is_taken(schema: dict[str, Any], text: str) -> None:
    with pytest.raises(InvalidError) as caught:
        check_schema({"allOf": [schema]} if "items" in schema else schema, "spec.params")
    assert text in str(caught.value)
    check_schema({"properties": {"a": {"enum": [{"pattern": "("}], "default": {"pattern": "("}}}}, "spec.params")


def test_one_that_was_taken_once_says_so_too() -> None:
    with pytest.raises(InvalidError, match="correct the manifest"):
        check_params({"a": "b"}, {"properties": {"a": {"pattern": "(?=a)b"}}}, "s")
