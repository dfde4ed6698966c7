"""Every request of the orchestrator's REST interface as a page, from its OpenAPI document: ``make docs`` writes it.

The document has no descriptions of fields: the orchestrator would read its own source for them at each start. They are
read here, from the strings below the fields.
"""

from __future__ import annotations

import ast
import inspect
import json
import sys
import tempfile
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

from skytether.api.manifest import Strict
from skytether.orchestrator.config.settings import Settings
from skytether.orchestrator.core import Orchestrator
from skytether.orchestrator.http.app import create_app

_HEAD = """\
# REST

Every request to an orchestrator, made from its OpenAPI document (`make docs`). A running orchestrator has the same
document at `/openapi.json`, and shows it at `/docs`, where requests can be tried.

Each request needs a token, as `Authorization: Bearer TOKEN`, unless it says otherwise
([who may what](operating.md#who-may-what)). Errors are documents of [Problem](#problem). Times are RFC 3339 in UTC. An
unknown key of a body is refused by name. What may be sent again, and when, is under
[several orchestrators](operating.md#several-orchestrators-restarts-updates).
"""
_LIMITS = {
    "exclusiveMinimum": "above {}",
    "minimum": "at least {}",
    "exclusiveMaximum": "below {}",
    "maximum": "at most {}",
    "minLength": "{} or more characters",
    "maxLength": "at most {} characters",
    "maxItems": "at most {} elements",
    "maxProperties": "at most {} keys",
    "pattern": "`{}`",
}


def document() -> dict[str, Any]:
    """As an orchestrator with default settings serves it."""
    with tempfile.TemporaryDirectory() as folder:
        found: dict[str, Any] = create_app(Orchestrator(Settings(state_dir=Path(folder, "state")))).openapi()
    return found


def page() -> str:
    """All requests by subject, then all documents by name."""
    api = document()
    subjects: dict[str, list[str]] = {}
    for path, operations in api["paths"].items():
        for method, operation in operations.items():
            text = "\n".join(_request(method.upper(), path, operation))
            subjects.setdefault(operation["tags"][0].capitalize(), []).append(text)
    parts = [_HEAD]
    parts += [f"## {subject}\n\n" + "\n".join(requests) for subject, requests in subjects.items()]
    parts += ["## Documents\n\n" + "\n".join(_schema(name, of) for name, of in _schemas(api))]
    return "\n".join(parts)


def _request(method: str, path: str, operation: dict[str, Any]) -> Iterator[str]:
    yield f"### {method} {path}\n"
    yield _prose(operation.get("description", operation["summary"])) + "\n"
    if "security" not in operation:
        yield "Without a token.\n"
    given = operation.get("parameters", ())
    if given:
        rows = (
            (f"`{one['name']}`", one["in"], *_told(one["schema"], required=one.get("required", False))) for one in given
        )
        yield _table(("parameter", "in", "type", "default"), rows)
    if body := operation.get("requestBody"):
        yield f"Body: {_kind(_content(body))}{'' if body.get('required') else ', or none'}.\n"
    answers, errors = [], []
    for status, answer in operation["responses"].items():
        if int(status) >= 400:
            errors.append(f"`{status}`")
        else:
            answers.append(f"`{status}` {_kind(_content(answer))}".strip())
    yield f"Answers: {', '.join(answers)}.{f' Errors: {chr(44).join(errors)}.'.replace(',', ', ') if errors else ''}\n"


def _content(part: dict[str, Any]) -> dict[str, Any]:
    contents = list(part.get("content", {}).values())
    found: dict[str, Any] = contents[0].get("schema", {}) if contents else {"nothing": True}
    return found


def _schemas(api: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    return sorted(
        (name, of) for name, of in api["components"]["schemas"].items() if not name.endswith("ValidationError")
    )


def _schema(name: str, of: dict[str, Any]) -> str:
    lines = [f"### {name}\n"]
    if text := of.get("description"):
        lines.append(_prose(text) + "\n")
    if "enum" in of:
        lines.append(f"One of {', '.join(f'`{value}`' for value in of['enum'])}.\n")
    means = _meanings(name, set(of.get("properties", ())))
    required = of.get("required", ())
    rows = [
        (
            f"`{key}`",
            *_told(field, required=key in required),
            _prose(means.get(key) or field.get("description", "")).replace("\n", " "),
        )
        for key, field in of.get("properties", {}).items()
    ]
    if rows:
        lines.append(_table(("key", "type", "default", "means"), rows))
    return "\n".join(lines)


def _told(field: dict[str, Any], *, required: bool) -> tuple[str, str]:
    """Type and default."""
    if required:
        return _kind(field), "must be given"
    default = field.get("default")
    return _kind(field), "" if default is None else f"`{json.dumps(default)}`"


def _kind(field: dict[str, Any]) -> str:
    if "nothing" in field:
        return ""
    if "$ref" in field:
        name = field["$ref"].rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    for several in ("anyOf", "oneOf", "allOf"):
        if several in field:
            return " or ".join(dict.fromkeys(_kind(one) for one in field[several]))
    if "enum" in field or "const" in field:
        return ", ".join(f"`{value}`" for value in field.get("enum", [field.get("const")]))
    kind = str(field.get("type", "any"))
    if kind == "array":
        kind = f"list of {_kind(field.get('items', {}))}"
    elif kind == "object":
        inner = [*field.get("patternProperties", {}).values(), field.get("additionalProperties")]
        kind = next((f"{_kind(one)} by name" for one in inner if isinstance(one, dict)), "object")
    elif field.get("format") == "date-time":
        kind = "time"
    limits = [text.format(_short(field[limit])) for limit, text in _LIMITS.items() if limit in field]
    return ", ".join([kind, *limits]).replace("|", "\\|")


def _short(limit: object) -> object:
    return int(limit) if isinstance(limit, float) and limit.is_integer() else limit


def _prose(text: str) -> str:
    return inspect.cleandoc(text).replace("``", "`")


def _table(head: tuple[str, ...], rows: Iterator[tuple[str, ...]] | list[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _meanings(name: str, keys: set[str]) -> dict[str, str]:
    """What the strings below the fields of a class say, with those of its bases; ``keys`` tell it from namesakes."""
    found: dict[str, str] = {}
    for one in _classes():
        if one.__name__ == name and one.model_fields.keys() == keys:
            for base in reversed(one.__mro__):
                found |= _below_fields(base) if issubclass(base, Strict) and base is not Strict else {}
    return found


@cache
def _classes() -> list[type[Strict]]:
    classes = [Strict]
    for one in classes:
        classes += one.__subclasses__()
    return classes


def _below_fields(one: type) -> dict[str, str]:
    body = ast.parse(inspect.getsource(one)).body[0].body  # type: ignore[attr-defined]
    return {
        field.target.id: text.value.value
        for field, text in pairwise(body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
        and isinstance(text.value.value, str)
    }


if __name__ == "__main__":
    sys.stdout.write(page())
