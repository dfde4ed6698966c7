"""YAML configurations of commands: how they are read, and what is said of a mistake in one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, Field, ValidationError

from skytether.api.manifest import Strict
from skytether.api.validation_errors import explain
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


def read_config(path: Path, model: type[_Model], lay: Callable[[Any], Any] = lambda document: document) -> _Model:
    """Read and check a configuration.

    Args:
        path: Of the YAML file.
        model: Its schema.
        lay: What is laid over the file before it is checked.

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
    return check_config(lay(documents[0] if documents else None), model, str(path))


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
        raise ConfigError(f"{where}: {'; '.join(map(str, explain(error, model)))}") from error
