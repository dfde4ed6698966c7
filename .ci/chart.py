"""What of the chart is made from ``helm/values.schema.yaml``: values, their schema, the page of documentation.

``make docs`` writes them. Kinds of Kubernetes come from its own schemas, documents of Skytether from its models: a
chart that refuses a key by name has to know all of them.
"""

from __future__ import annotations

import importlib.resources
import json
import re
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from skytether.api.manifest import Manifest
from skytether.api.rest import SiteCreate
from skytether.bridge.relay_config import RelayConfig
from skytether.orchestrator.config.settings import Settings
from skytether.orchestrator.runtimes.docker.options import DockerOptions
from skytether.orchestrator.runtimes.kubernetes.options import KubernetesOptions

ROOT = Path(__file__).resolve().parent.parent
CHART = ROOT / "helm" / "skytether"
SOURCE = ROOT / "helm" / "values.schema.yaml"
KUBERNETES = "1.37.0"
_GROUPS = ("io.k8s.api.core.v1.", "io.k8s.api.networking.v1.", "io.k8s.apimachinery.pkg.apis.meta.v1.")
_OURS = ("state_dir", "host", "port", "database_url", "secrets_dir", "catalog_dir", "sites_file", "advertise")
_OURS += ("local_site", "echo", "insecure_http", "tls", "nodes")
"""Settings that the chart sets."""
_LEFT_OUT = ("title", "default", "description", "format", "discriminator")
_LINE = 118

Schema = dict[str, Any]

_PAGE = """\
# Values of the chart

What [the chart](helm.md) can be told, beside its defaults. A wrong key is refused by name, at any depth; what is a kind
of Kubernetes (in brackets) has the keys of Kubernetes {version}. This page, `values.yaml` and `values.schema.json` are
made from `helm/values.schema.yaml` (`make docs`).

| value | default | means |
| --- | --- | --- |
"""


def metadata() -> Schema:
    """What `Chart.yaml` holds."""
    document: Schema = yaml.safe_load((CHART / "Chart.yaml").read_text())
    return document


def source() -> Schema:
    """The values as they are written."""
    document: Schema = yaml.safe_load(SOURCE.read_text())
    return {"properties": document["properties"]}


@cache
def _kinds() -> Schema:
    folder = importlib.resources.files("kubernetes_validate") / "kubernetes-json-schema"
    text = (folder / f"v{KUBERNETES}-local-strict" / "_definitions.json").read_text()
    found: Schema = json.loads(text)["$defs"]
    return found


def _model(name: str) -> Schema:
    """A document of Skytether as a schema with its own definitions."""
    match name:
        case "Settings":
            found = Settings.model_json_schema()
            found["properties"] = {key: one for key, one in found["properties"].items() if key not in _OURS}
        case "Relay":
            found = RelayConfig.model_json_schema()
            del found["properties"]["listen"]
        case "Manifest":
            found = Manifest.model_json_schema(by_alias=True)
        case "Site":
            found = SiteCreate.model_json_schema()
            del found["properties"]["name"]
            found["properties"]["runtime"] = {"enum": ["kubernetes", "docker"]}
            found["required"] = ["tier", "runtime"]
            found["allOf"] = []
            for runtime, options in (("kubernetes", KubernetesOptions), ("docker", DockerOptions)):
                inner = options.model_json_schema()
                found["$defs"] = found.get("$defs", {}) | inner.pop("$defs", {}) | {options.__name__: inner}
                means = {"properties": {"options": {"$ref": f"#/$defs/{options.__name__}"}}}
                found["allOf"].append({"if": {"properties": {"runtime": {"const": runtime}}}, "then": means})
    return found


def _plain(node: Any, prefix: str, *, names: bool = False) -> Any:
    """Without what explains only, with references that begin with ``prefix``; ``names``: its keys are no keywords."""
    if isinstance(node, list):
        return [_plain(one, prefix) for one in node]
    if not isinstance(node, dict):
        return node
    made: Schema = {}
    for key, one in node.items():
        if key == "$ref":
            made[key] = f"#/definitions/{prefix}{one.rpartition('/')[2]}"
        elif key == "prefixItems":  # a pair of ports: `items` of a list is draft 7's word
            made["items"] = [_plain(each, prefix) for each in one]
        elif names or (key not in (*_LEFT_OUT, "$defs") and not key.startswith("x-kubernetes")):
            made[key] = _plain(
                one, prefix, names=not names and key in ("properties", "patternProperties", "definitions")
            )
    return made


def schema() -> Schema:
    """What `values.schema.json` holds."""
    definitions: Schema = {}
    made = _typed(source(), definitions)
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        **made,
        "definitions": dict(sorted(definitions.items())),
    }


def _typed(node: Schema, definitions: Schema) -> Schema:
    if "k8s" in node or "model" in node:
        return {"$ref": _define(node, definitions)}
    made = {
        key: one for key, one in node.items() if key not in ("default", "properties", "items", "additionalProperties")
    }
    if "properties" in node:
        made |= {"type": "object", "additionalProperties": False}
        made["properties"] = {key: _typed(one, definitions) for key, one in node["properties"].items()}
    for key in ("items", "additionalProperties"):
        if key in node:
            made[key] = _typed(node[key], definitions)
    return made


def _define(node: Schema, definitions: Schema) -> str:
    if "model" in node:
        name, found = node["model"], _model(node["model"])
        inner = found.pop("$defs", {})
        definitions |= {f"{name}.{key}": _plain(one, f"{name}.") for key, one in inner.items()}
        definitions[name] = _plain(found, f"{name}.")
        return f"#/definitions/{name}"
    full = next(group + node["k8s"] for group in _GROUPS if group + node["k8s"] in _kinds())
    wanted = [full]
    while wanted:
        name = wanted.pop()
        if name not in definitions:
            definitions[name] = one = _plain(_kinds()[name], "")
            if "object" in one.get("type", ()) and not {"properties", "additionalProperties"} & one.keys():
                one["additionalProperties"] = False  # the server's own notes of who manages which field
            wanted += re.findall(r"#/definitions/([\w.-]+)", json.dumps(definitions[name]))
    return f"#/definitions/{full}"


def leaves(node: Schema, above: str = "") -> Iterator[tuple[str, Schema]]:
    """Every value with its dotted name; what has a default is one, whatever is in it."""
    for key, one in node["properties"].items():
        if "default" in one:
            yield above + key, one
        else:
            yield from leaves(one, f"{above}{key}.")


def values() -> str:
    """What `values.yaml` holds: every value with its default, and what it means."""
    head = "# Made from helm/values.schema.yaml by `make docs`; all values as a page: docs/helm-values.md.\n"
    return head + "".join(_written(source(), ""))


def _written(node: Schema, indent: str) -> Iterator[str]:
    for key, one in node["properties"].items():
        if not indent:
            yield "\n"
        if "description" in one:
            yield from (f"{indent}# {line}\n" for line in _wrapped(one["description"], _LINE - len(indent) - 2))
        if "default" in one:
            yield f"{indent}{key}: {_flow(one['default'])}\n"
        else:
            yield f"{indent}{key}:\n"
            yield from _written(one, f"{indent}  ")


def _wrapped(text: str, width: int) -> Iterable[str]:
    lines = [""]
    for word in text.split():
        if len(lines[-1]) + len(word) + 1 > width:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return lines


def _flow(value: Any) -> str:
    return yaml.safe_dump(value, default_flow_style=True, width=10_000, sort_keys=False).removesuffix("...\n").strip()


def page() -> str:
    """The whole page of documentation."""
    rows = []
    for name, one in leaves(source()):
        default = "" if one["default"] in ({}, [], "", None) else f"`{_flow(one['default'])}`"
        means = one["description"].replace("|", "\\|")
        rows.append(f"| `{name}` | {default} | {means}{_choices(one)} |\n")
    return _PAGE.format(version=KUBERNETES.rpartition(".")[0]) + "".join(rows)


def _choices(one: Schema) -> str:
    if "enum" in one:
        return " " + ", ".join(f"`{choice}`" for choice in one["enum"] if choice) + "."
    kind = one.get("k8s") or one.get("items", {}).get("k8s")
    return f" ({kind})" if kind else ""


def files() -> dict[Path, str]:
    """What is made, by where it is written to."""
    return {
        CHART / "values.yaml": values(),
        CHART / "values.schema.json": json.dumps(schema(), separators=(",", ":"), sort_keys=True) + "\n",
        ROOT / "docs" / "helm-values.md": page(),
    }


if __name__ == "__main__":
    for path, text in files().items():
        path.write_text(text)
    sys.exit(0)
