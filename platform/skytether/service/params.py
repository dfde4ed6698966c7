"""Parameters: one frozen dataclass, from which come defaults, checks and the JSON schema of the manifest."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError, create_model
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import core_schema

from .errors import ConfigError

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class NoParams:
    """For a service that has none."""


def param(
    default: Any = dataclasses.MISSING,
    *,
    doc: str,
    unit: str | None = None,
    gt: float | None = None,
    ge: float | None = None,
    lt: float | None = None,
    le: float | None = None,
    min_length: int | None = None,
    max_length: int | None = None,
    pattern: str | None = None,
) -> Any:
    """Declare a parameter in a frozen dataclass; also in one that another parameter nests.

    Args:
        default: Immutable (a tuple, not a list); without it the parameter must be given.
        doc: What it does, for people who set it.
        unit: SI unit, ``kg``; told in the schema, not checked.
        gt: Must be greater than this.
        ge: Must be at least this.
        lt: Must be less than this.
        le: Must be at most this.
        min_length: Of a text or a list.
        max_length: Of a text or a list.
        pattern: Regular expression that a text must match.
    """
    limits: dict[str, Any] = {
        "gt": gt,
        "ge": ge,
        "lt": lt,
        "le": le,
        "min_length": min_length,
        "max_length": max_length,
        "pattern": pattern,
    }
    metadata = {key: value for key, value in limits.items() if value is not None}
    metadata["description"] = doc
    if unit is not None:
        metadata["json_schema_extra"] = {"unit": unit}
    return dataclasses.field(default=default, metadata=metadata)


def read_params(cls: type[T], given: Mapping[str, Any]) -> T:
    """Check what was given against the dataclass ``cls``, and make one.

    Raises:
        ConfigError: Names each key that is unknown, missing or wrong, and what is allowed; or says what the
            ``ValueError`` says that ``cls`` raises in its ``__post_init__``.
    """
    try:
        model = _model(cls).model_validate_json(json.dumps({"params": given}))
    except ValidationError as error:
        problems = error.errors(include_url=False)
        places = [problem["loc"] for problem in problems]
        # A list whose elements are wrong is also reported as too short: the elements say it better.
        inner = [p for p in problems if not any(p["loc"] == q[: len(p["loc"])] for q in places if q != p["loc"])]
        raise ConfigError("; ".join(dict.fromkeys(_sentence(cls, dict(p)) for p in inner))) from None
    return model.params  # type: ignore[attr-defined, no-any-return]


def schema_of(cls: type[Any]) -> dict[str, Any]:
    """JSON schema (2020-12) of a parameter dataclass."""
    document = _model(cls).model_json_schema(schema_generator=_WithoutTitles)
    definitions = document["$defs"]
    schema: dict[str, Any] = definitions.pop(document["properties"]["params"]["$ref"].rpartition("/")[2])
    schema.setdefault("additionalProperties", False)
    if definitions:
        schema["$defs"] = definitions
    return schema


def _model(cls: type[Any]) -> type[BaseModel]:
    """A model around ``cls``: pydantic hands its strictness down to plain dataclasses only this way."""
    config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
    return create_model("_", __config__=config, params=(cls, ...))


class _WithoutTitles(GenerateJsonSchema):
    """Titles made from names and docstrings say nothing that the keys do not."""

    def field_title_should_be_set(self, schema: Any) -> bool:  # noqa: ARG002
        return False

    def dataclass_schema(self, schema: core_schema.DataclassSchema) -> dict[str, Any]:
        return _plain(super().dataclass_schema(schema))


def _plain(schema: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in schema.items() if key not in ("title", "description")}


def _sentence(cls: type[Any], problem: dict[str, Any]) -> str:
    key = ".".join(str(part) for part in problem["loc"][1:])
    if problem["type"] == "value_error":  # raised by the dataclass's own __post_init__
        return f"parameter '{key}': {problem['ctx']['error']}" if key else f"parameters: {problem['ctx']['error']}"
    if not key:
        return f"parameters must be a mapping, not {problem['input']!r}"
    match problem["type"]:
        case "unexpected_keyword_argument" | "extra_forbidden":
            known = ", ".join(field.name for field in dataclasses.fields(cls))
            hint = f"; there are {known}" if len(problem["loc"]) == 2 and known else ""
            return f"there is no parameter '{key}'{hint}"
        case "missing":
            return f"parameter '{key}' is missing"
        case _:
            text = problem["msg"][0].lower() + problem["msg"][1:]
            return f"parameter '{key}': {text}, not {json.dumps(problem['input'])}"
