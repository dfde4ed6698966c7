"""An orchestrator's configuration: from a file, the environment and the command line, in rising order of precedence.

And its documentation, made from the settings themselves, so that it cannot drift from them.

pydantic-settings could read the environment. It was tried: lists have to be JSON there and a wrong one is refused
without a word on how to write it, errors name the field and not the variable that was set, and it takes 40 ms to
import; what it would replace is twenty lines.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import yaml
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from skytether.api.yaml import YamlError, parse_yaml, read_bounded

from ..domain.errors import Fault, InvalidError
from ..domain.validation import parse
from .settings import Settings

PREFIX = "SKYTETHER_"
_MAPPED = {"SKYTETHER_DATABASE": ("database_url",)}
"""Older names of variables."""


_PAGE = """\
# Configuration of the orchestrator

`skytether orchestrator run --config FILE` reads a YAML file; `skytether orchestrator config` prints one with every key.
Each key is a variable of the environment too (`limits.body_bytes`: `SKYTETHER_LIMITS_BODY_BYTES`), which goes before
the file; options of the command line go before both. A wrong key or value is refused by name.

This page is made from the settings (`make docs`). Times are in seconds.

| key | default | means |
| --- | --- | --- |"""


def load(file: Path | None, environment: Mapping[str, str], given: Mapping[str, Any]) -> Settings:
    """Put the settings together.

    Args:
        file: YAML; None: none.
        environment: Variables; ``SKYTETHER_LIMITS_BODY_BYTES`` is ``limits.body_bytes``. Others are not looked at.
        given: From the command line, top-level keys; None counts as not given.

    Raises:
        InvalidError: The file cannot be read, or a value is wrong; the text names key or variable.
    """
    document = _read(file) if file is not None else {}
    for variable, path in _variables().items():
        if variable in environment:
            _put(document, path, _value(variable, environment[variable]))
    for key, value in given.items():
        if value is not None:
            document[key] = value
    return parse(Settings, document, str(file) if file is not None else "")


def seen_by_others(file: Path | None, given: Mapping[str, Any]) -> str:
    """How other users of the machine read the database's password; empty: not by what is given here."""
    instead = "write it into a file with mode 0600 (?passfile=FILE in the address, as PostgreSQL's clients read it)"
    if _has_password(given.get("database_url")):
        return f"other users of this machine can read the database's password among the arguments: {instead}"
    if (
        file is not None
        and file.is_file()
        and file.stat().st_mode & 0o007
        and _has_password(_read(file).get("database_url"))
    ):
        return f"other users of this machine can read the database's password in {file}: chmod 600 it, or {instead}"
    return ""


def _has_password(address: object) -> bool:
    try:
        parts = urlsplit(str(address or ""))
    except ValueError:  # no address at all: it is refused later
        return False
    return bool(parts.password or parse_qs(parts.query).get("password"))


def _read(file: Path) -> dict[str, Any]:
    try:
        documents = parse_yaml(read_bounded(file), file)
    except OSError as error:
        raise InvalidError([Fault("", f"cannot read {file}: {error.strerror}")]) from error
    except YamlError as error:
        raise InvalidError([Fault("", str(error))]) from error
    document = documents[0] if documents else {}
    if len(documents) > 1 or not isinstance(document, dict):
        raise InvalidError([Fault("", f"{file} must hold one document of keys; see `skytether orchestrator config`")])
    return document


def _variables() -> dict[str, tuple[str, ...]]:
    named = {PREFIX + "_".join(path).upper(): path for path, _ in leaves(Settings)}
    return {**_MAPPED, **named}


def _value(variable: str, text: str) -> Any:
    """As YAML would read it, so that numbers, truth values and lists can be given; text stays text."""
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise InvalidError([Fault(variable, "is no value that YAML can read: put it in quotes")]) from error


def _put(document: dict[str, Any], path: tuple[str, ...], value: Any) -> None:
    for key in path[:-1]:
        inner = document.setdefault(key, {})
        if not isinstance(inner, dict):
            return  # wrong in the file: the check names it
        document = inner
    document[path[-1]] = value


def leaves(model: type[BaseModel], above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], FieldInfo]]:
    """Every key with its field, groups entered, in the order of the settings."""
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from leaves(field.annotation, (*above, name))
        else:
            yield (*above, name), field


def example() -> str:
    """A configuration file with every key, its default and what it means."""
    lines = ["# Every key of an orchestrator's configuration, with its default. Times are in seconds."]
    group: tuple[str, ...] = ()
    for path, field in leaves(Settings):
        if path[:-1] != group:
            group = path[:-1]
            lines += ["", f"{group[-1]}:"]
        indent = "  " * len(group)
        lines += [f"{indent}# {line}" for line in _description(field).splitlines()]
        lines.append(f"{indent}{path[-1]}: {_default(field)}")
    return "\n".join(lines) + "\n"


def page() -> str:
    """The same as a page of documentation."""
    lines = [_PAGE]
    for path, field in leaves(Settings):
        text = " ".join(_description(field).split()).replace("|", "\\|")
        lines.append(f"| `{'.'.join(path)}` | `{_default(field)}` | {text} |")
    return "\n".join(lines) + "\n"


def _description(field: FieldInfo) -> str:
    return field.description or ""


def _default(field: FieldInfo) -> str:
    if field.default_factory is not None:
        return "~/.local/state/skytether"
    value = list(field.default) if isinstance(field.default, tuple) else field.default
    return yaml.safe_dump(value, default_flow_style=True).replace("\n...", "").strip()
