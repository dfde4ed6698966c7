"""``--option KEY=VALUE``, as several commands take it."""

from __future__ import annotations

from typing import Any

from .output import fail


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
