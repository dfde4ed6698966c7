"""YAML configurations of commands: how they are read, and what is said of a mistake in one."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, Field, ValidationError

from skytether.api.manifest import Strict
from skytether.api.yaml import YamlError, parse_yaml, read_bounded

_Model = TypeVar("_Model", bound=BaseModel)


class ConfigError(Exception):
    """A mistake in the configuration; the text names the key and what it may be."""


class Endpoint(Strict):
    """A UDP endpoint."""

    host: Annotated[str, Field(min_length=1)] = "127.0.0.1"
    """Name or address, IPv4 or IPv6; to bind to: ``0.0.0.0`` or ``::`` for every interface."""
    port: Annotated[int, Field(ge=0, le=65_535)] = 0
    """To bind to: 0 takes any free one."""


def read_config(path: Path, model: type[_Model]) -> _Model:
    """Read and check a configuration.

    Args:
        path: Of the YAML file.
        model: Its schema.

    Raises:
        ConfigError: It cannot be read, is no YAML, or a key is wrong.
    """
    try:
        documents = parse_yaml(read_bounded(path), path)
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from error
    except YamlError as error:
        raise ConfigError(str(error)) from error
    if len(documents) > 1:
        raise ConfigError(f"{path} holds {len(documents)} documents; a configuration is one")
    return check_config(documents[0] if documents else None, model, str(path))


def check_config(document: Any, model: type[_Model], where: str) -> _Model:
    """Check what was read.

    Args:
        document: Keys and values.
        model: The schema.
        where: What to call it in a complaint.

    Raises:
        ConfigError: A key is wrong.
    """
    if not isinstance(document, dict):
        raise ConfigError(f"{where} must hold keys: {', '.join(model.model_fields)}")
    try:
        return model.model_validate(document)
    except ValidationError as error:
        raise ConfigError(f"{where}: {_explain(error, model)}") from error


def _explain(error: ValidationError, model: type[BaseModel]) -> str:
    """The first mistake, by its key."""
    first = error.errors(include_url=False, include_input=False)[0]
    key = ".".join(str(step) for step in first["loc"])
    if first["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        known = _known_keys(first["loc"][:-1], model)
        near = difflib.get_close_matches(str(first["loc"][-1]), known, n=1)
        return f"{key}: unknown key{f', did you mean {near[0]!r}?' if near else ''}; allowed are {', '.join(known)}"
    if first["type"] == "missing":
        return f"{key}: is missing"
    says = str(first["msg"]).removeprefix("Value error, ")
    return f"{key}: {says[:1].lower()}{says[1:]}" if key else says


def _known_keys(place: tuple[int | str, ...], model: type[BaseModel]) -> list[str]:
    """Keys that the schema has at one place of the document."""
    schema: dict[str, Any] = model.model_json_schema()
    here = schema
    for step in place:
        if isinstance(step, int):
            here = here["items"]
        else:
            here = here.get("properties", {}).get(step) or here["additionalProperties"]
        here = next((a for a in here.get("anyOf", ()) if a.get("type") != "null"), here)
        if "$ref" in here:
            here = schema["$defs"][here["$ref"].rsplit("/", 1)[1]]
    return list(here["properties"])
