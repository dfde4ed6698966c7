"""Refuses documents and parameters with all that is wrong in them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

from jsonschema import Draft202012Validator
from jsonschema.exceptions import ValidationError
from pydantic import BaseModel
from pydantic import ValidationError as PydanticError
from referencing import Registry
from referencing.exceptions import Unresolvable
from referencing.jsonschema import DRAFT202012

from skytether.api.validation_errors import MAX_FAULTS, Fault, explain, unknown

from .errors import InvalidError
from .patterns import PatternError, wrong_with
from .validation_budget import UNUSABLE, BudgetError, Validator, bounded

Model = TypeVar("Model", bound=BaseModel)

_SCHEMA_OF_SCHEMAS: Any = Validator(Draft202012Validator.META_SCHEMA)
_NAMING = ("properties", "patternProperties", "$defs", "dependentSchemas")
"""Keywords whose keys are names, whatever they are."""
_NO_ADDRESS = "an $id or $ref in it is no address"
_LONGEST = 300
"""Characters of what is said of a value."""


def parse(model: type[Model], document: Any, what: str = "", prefix: Sequence[str] = ()) -> Model:
    """Validate a document.

    Raises:
        InvalidError: With each wrong key.
    """
    try:
        return model.model_validate(document)
    except PydanticError as error:
        raise InvalidError(explain(error, model, prefix), what) from None


def check_schema(schema: Mapping[str, Any], prefix: str) -> None:
    """Is this a JSON schema of parameters?

    Raises:
        InvalidError: It is none; the fault names the key inside it.
    """
    error = next(_SCHEMA_OF_SCHEMAS.iter_errors(schema), None)
    if error is not None:
        raise InvalidError([Fault(_join(prefix, error.absolute_path), error.message[:_LONGEST])])
    _check_keywords(schema, prefix)
    try:
        here = _places_in(schema)
    except ValueError:
        raise InvalidError([Fault(prefix, _NO_ADDRESS)]) from None
    for path, reference in _references(schema):
        try:
            here.lookup(reference)
        except (Unresolvable, ValueError):  # the latter: it is no address
            text = f"there is no '{reference}' in this schema, and nothing is fetched from elsewhere"
            raise InvalidError([Fault(_join(prefix, path), text)]) from None


def _places_in(schema: Mapping[str, Any]) -> Any:
    """Finds what a schema's references mean. It has looked through it once, and does not for each name again.

    Raises:
        ValueError: An address in it is none.
    """
    # Nothing but the schema is in there: a manifest must not make this server fetch a reference from somewhere.
    resource = DRAFT202012.create_resource(dict(schema))
    name = resource.id() or ""
    return Registry().with_resource(name, resource).crawl().resolver(name)


def _check_keywords(schema: Mapping[str, Any], prefix: str) -> None:
    faults = []
    for path, key, value in _keywords(schema):
        patterns = [value] if key == "pattern" and isinstance(value, str) else []
        if key == "patternProperties" and isinstance(value, Mapping):
            patterns = [str(pattern) for pattern in value]
        faults += [Fault(_join(prefix, path), f"'{p[:80]}' {why}") for p in patterns if (why := wrong_with(p))]
        if key in UNUSABLE and path[-2:-1] not in [(word,) for word in _NAMING]:
            faults.append(Fault(_join(prefix, path), f"cannot be used; write {UNUSABLE[key]}"))
    if faults:
        raise InvalidError(faults[:MAX_FAULTS])


def _keywords(schema: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], str, Any]]:
    """All keys of a schema; examples and the like hold data, in which a key means nothing."""
    for key, inner in schema.items() if isinstance(schema, Mapping) else enumerate(schema):
        if isinstance(schema, Mapping):
            yield (*path, str(key)), str(key), inner
        if isinstance(inner, Mapping | list) and key not in ("const", "enum", "default", "examples"):
            yield from _keywords(inner, (*path, str(key)))


def _references(schema: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], str]]:
    for key, inner in schema.items() if isinstance(schema, Mapping) else enumerate(schema):
        here = (*path, str(key))
        if key in ("$ref", "$dynamicRef") and isinstance(inner, str):
            yield here, inner
        elif isinstance(inner, Mapping | list):
            yield from _references(inner, here)


def check_params(params: Mapping[str, Any], schema: Mapping[str, Any], service: str) -> None:
    """Validate parameters against a service's schema, in which unknown keys are refused unless it allows them.

    Raises:
        InvalidError: With each wrong key.
    """
    closed = {"additionalProperties": False, **schema}
    try:
        validator = Validator(closed, registry=Registry(), _resolver=_places_in(closed))
        with bounded(params):
            errors = sorted(validator.iter_errors(params), key=lambda e: [str(p) for p in e.absolute_path])
    except Unresolvable as error:
        raise InvalidError([Fault("spec.params", f"cannot resolve the reference {error.ref}")], service) from None
    except PatternError as error:
        raise InvalidError([Fault("spec.params", f"{error}: correct the manifest")], service) from None
    except ValueError:
        raise InvalidError([Fault("spec.params", f"{_NO_ADDRESS}: correct the manifest")], service) from None
    except BudgetError as error:
        text = f"{error}: give fewer of them, or let the manifest's schema say less"
        raise InvalidError([Fault("params", text)], f"service '{service}'") from None
    except RecursionError:
        text = "the schema refers to itself without end: correct the manifest"
        raise InvalidError([Fault("spec.params", text)], service) from None
    if errors:
        raise InvalidError([f for e in errors for f in _params_faults(e)][:MAX_FAULTS], f"service '{service}'")


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
    return [Fault(_join("params", here), error.message[:_LONGEST])]


def _join(prefix: str, path: Iterable[Any]) -> str:
    return ".".join([prefix, *(str(p) for p in path)])
