"""The parameters of a service as a page: ``make docs`` writes it for ``navigation`` and ``follow-in-front``."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from typing import Any

from skytether.service import Service, params_schema
from skytether_services.follow_in_front.service import FollowInFront
from skytether_services.navigation.service import Navigation

_SERVICES: dict[str, type[Service[Any]]] = {"navigation": Navigation, "follow-in-front": FollowInFront}

_PAGE = """\
# Parameters of {name}

What a robot may set when it asks for the service [{name}]({name}.md). A wrong key or value is refused by name.
`[]` is an element of a list; what has no default must be given. This page is made from the code (`make docs`).

| parameter | default | unit | limits | means |
| --- | --- | --- | --- | --- |
"""
_LIMITS = {
    "exclusiveMinimum": "> {}",
    "minimum": ">= {}",
    "exclusiveMaximum": "< {}",
    "maximum": "<= {}",
    "maxLength": "{} characters",
    "maxItems": "{} elements",
}


def rows(schema: dict[str, Any]) -> Iterator[tuple[str, str, str, str, str]]:
    """One for each parameter: key, default, unit, limits, meaning."""
    yield from _rows(schema, schema.get("$defs", {}), "", schema.get("default", {}))


def _rows(
    schema: dict[str, Any], definitions: dict[str, Any], above: str, defaults: dict[str, Any]
) -> Iterator[tuple[str, str, str, str, str]]:
    for key, field in schema["properties"].items():
        name = above + key
        kind = _resolved(field, definitions)
        given = key in defaults or "default" in field
        default = defaults.get(key, field.get("default"))
        if "properties" in kind and default is not None:
            yield from _rows(kind, definitions, f"{name}.", default)
            continue
        limits = [text.format(kind[limit]) for limit, text in _LIMITS.items() if limit in kind]
        limits += [", ".join(f"`{value}`" for value in kind["enum"])] if "enum" in kind else []
        shown = f"`{json.dumps(_rounded(default))}`" if given else ""
        yield name, shown, str(field.get("unit", "")), "; ".join(limits), field.get("description", "")
        inner = _resolved(kind.get("items", {}), definitions) if "items" in kind else kind
        if "properties" in inner:
            yield from _rows(inner, definitions, f"{name}[]." if "items" in kind else f"{name}.", {})


def _resolved(field: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    """With what a reference stands for; of a parameter that may be none, what it is otherwise."""
    for one in field.get("anyOf", ()):
        if one.get("type") != "null":
            field = {**field, **one}
    if "$ref" in field:
        return {**field, **definitions[field["$ref"].rpartition("/")[2]]}
    return field


def _rounded(value: Any) -> Any:
    """With four digits of each number: sums like 0.35 - 0.08 have sixteen."""
    if isinstance(value, float):
        return float(f"{value:.4g}")
    if isinstance(value, list):
        return [_rounded(one) for one in value]
    return {key: _rounded(one) for key, one in value.items()} if isinstance(value, dict) else value


def page(service: str) -> str:
    """The whole page of a service."""
    lines = []
    for name, *others in rows(params_schema(_SERVICES[service])):
        cells = [f"`{name}`", *others]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n")
    return _PAGE.format(name=service) + "".join(lines)


if __name__ == "__main__":
    print(page(sys.argv[1]), end="")  # noqa: T201 (what a script prints)
