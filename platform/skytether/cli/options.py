"""``--option KEY=VALUE``, and what is asked for, as several commands take them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeVar

from .output import fail

if TYPE_CHECKING:
    from pydantic import BaseModel

_Request = TypeVar("_Request", bound="BaseModel")


def checked(kind: type[_Request], asked: Mapping[str, Any]) -> _Request:
    """A request as it is asked for; one that cannot be ends the command with a sentence."""
    from pydantic import ValidationError

    from skytether.api.validation_errors import explain

    try:
        return kind.model_validate(asked)
    except ValidationError as error:
        fail("; ".join(str(fault) for fault in explain(error, kind)), 2)


def options_of(entries: list[str] | None) -> dict[str, Any]:
    """What ``--option KEY=VALUE`` says."""
    options = {}
    for entry in entries or ():
        key, is_, value = entry.partition("=")
        if not is_:
            fail(f"--option {entry}: write KEY=VALUE", 2)
        options[key] = value_of(value)
    return options


def value_of(text: str) -> Any:
    """A value of an option, as YAML reads it; what is none is text."""
    import yaml

    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        return text
