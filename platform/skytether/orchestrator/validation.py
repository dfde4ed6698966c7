"""Turns what pydantic and jsonschema find wrong into faults: full key path, and the nearest known key."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

from jsonschema import Draft202012Validator
from jsonschema.exceptions import SchemaError, ValidationError
from pydantic import BaseModel
from pydantic import ValidationError as PydanticError
from referencing import Registry
from referencing.exceptions import Unresolvable

from .errors import Fault, InvalidError

Model = TypeVar("Model", bound=BaseModel)
_MAX_FAULTS = 10
"""More help nobody."""


def parse(model: type[Model], document: Any, what: str = "", prefix: Sequence[str] = ()) -> Model:
    """Validate a document.

    Raises:
        InvalidError: With each wrong key.
    """
    try:
        return model.model_validate(document)
    except PydanticError as error:
        raise InvalidError(faults(error.errors(), model.model_json_schema(), prefix), what) from None


def faults(errors: Iterable[Mapping[str, Any]], schema: Mapping[str, Any], prefix: Sequence[str] = ()) -> list[Fault]:
    """Pydantic's errors in words; ``schema`` is the document's JSON schema, to find known keys in."""
    found = []
    for error in errors:
        path = list(error["loc"])
        if error["type"] == "extra_forbidden":
            detail = unknown(str(path[-1]), _keys(schema, path[:-1]))
        elif error["type"] == "missing":
            detail = "is missing"
        elif error["type"] in ("model_type", "model_attributes_type", "dict_type"):
            detail = "must be a mapping of keys to values"
        else:
            message = str(error["msg"]).removeprefix("Value error, ")
            detail = message[:1].lower() + message[1:]
        found.append(Fault(".".join([*prefix, *(str(p) for p in path)]), detail))
    return found[:_MAX_FAULTS]


def unknown(key: str, known: Iterable[str]) -> str:
    """What to say of an unknown key."""
    candidates = list(known)
    near = difflib.get_close_matches(key, candidates, n=1)
    if near:
        return f"unknown key, did you mean '{near[0]}'?"
    return f"unknown key; known are {', '.join(candidates)}" if candidates else "unknown key; there are none"


def _keys(schema: Mapping[str, Any], path: Sequence[Any]) -> list[str]:
    """Known keys at a place in a document, by its JSON schema."""
    places = [schema]
    for step in [*path, None]:
        places = [_resolve(schema, place) for place in places]
        places = [p for place in places for p in (place, *(_resolve(schema, a) for a in place.get("anyOf", [])))]
        if step is None:
            break
        if isinstance(step, int):
            places = [place["items"] for place in places if isinstance(place.get("items"), Mapping)]
        else:
            places = [place["properties"][step] for place in places if step in place.get("properties", {})]
    return sorted({key for place in places for key in place.get("properties", {})})


def _resolve(schema: Mapping[str, Any], place: Mapping[str, Any]) -> Mapping[str, Any]:
    if "$ref" in place:
        found = schema.get("$defs", {}).get(str(place["$ref"]).removeprefix("#/$defs/"), {})
        return found if isinstance(found, Mapping) else {}
    return place


def check_schema(schema: Mapping[str, Any], prefix: str) -> None:
    """Is this a JSON schema of parameters?

    Raises:
        InvalidError: It is none; the fault names the key inside it.
    """
    try:
        Draft202012Validator.check_schema(schema)
    except SchemaError as error:
        raise InvalidError([Fault(_join(prefix, error.absolute_path), error.message)]) from None


def check_params(params: Mapping[str, Any], schema: Mapping[str, Any], service: str) -> None:
    """Validate parameters against a service's schema, in which unknown keys are refused unless it allows them.

    Raises:
        InvalidError: With each wrong key.
    """
    closed = {"additionalProperties": False, **schema}
    # An empty registry: a manifest must not make this server fetch a reference from somewhere.
    validator = Draft202012Validator(closed, registry=Registry())
    try:
        errors = sorted(validator.iter_errors(params), key=lambda e: [str(p) for p in e.absolute_path])
    except Unresolvable as error:
        raise InvalidError([Fault("spec.params", f"cannot resolve the reference {error.ref}")], service) from None
    if errors:
        raise InvalidError([f for e in errors for f in _params_faults(e)][:_MAX_FAULTS], f"service '{service}'")


def _params_faults(error: ValidationError) -> list[Fault]:
    here = [*error.absolute_path]
    schema = error.schema if isinstance(error.schema, Mapping) else {}
    if error.validator == "required" and isinstance(error.instance, Mapping):
        required: list[str] = list(schema.get("required", []))
        return [Fault(_join("params", [*here, k]), "is missing") for k in required if k not in error.instance]
    if (
        error.validator == "additionalProperties"
        and isinstance(error.instance, Mapping)
        and "patternProperties" not in schema
    ):
        known = schema.get("properties", {})
        extra = [key for key in error.instance if key not in known]
        return [Fault(_join("params", [*here, key]), unknown(str(key), known)) for key in extra]
    return [Fault(_join("params", here), error.message[:300])]


def _join(prefix: str, path: Iterable[Any]) -> str:
    return ".".join([prefix, *(str(p) for p in path)])
