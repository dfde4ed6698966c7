"""The chart as Helm's own engine renders it, for a release `demo` in a namespace `ns`."""

from __future__ import annotations

import importlib.resources
import importlib.util
import json
import re
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
from jsonschema import Draft202012Validator
from referencing import Registry, Resource

helm_python = pytest.importorskip("helm_python", reason="Helm's engine is built for Linux on x86_64 only")

ROOT = Path(__file__).parents[2]
CHART = ROOT / "helm" / "skytether"
OLDEST, NEWEST = "v1.20.0", "v1.37.0"
ABSENT = object()
"""What there is at a path where nothing is."""

Values = dict[str, Any]
Object = dict[str, Any]


@cache
def script() -> ModuleType:
    """`.ci/chart.py`, which is no part of a package."""
    spec = importlib.util.spec_from_file_location("chart_script", ROOT / ".ci" / "chart.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@cache
def _chart() -> Any:
    return helm_python.Chart.load(CHART)


def files(values: Values, kube: str = NEWEST, apis: tuple[str, ...] = (), *, upgrade: bool = False) -> dict[str, str]:
    """By template what comes of it, on a cluster of this version with these APIs of others."""
    asked: Values = {"name": "demo", "namespace": "ns", "kube_version": kube, "api_versions": list(apis)}
    asked |= {"is_install": not upgrade, "is_upgrade": upgrade}
    # `Chart.render` has no word for the cluster's version, which the library underneath takes.
    chart = _chart()._raw()  # noqa: SLF001
    text = helm_python._native.call_string("helm_render", chart, json.dumps(values), json.dumps(asked))  # noqa: SLF001
    rendered: dict[str, str] = json.loads(text)
    return {name.removeprefix("skytether/templates/"): one for name, one in rendered.items()}


def objects(values: Values, kube: str = NEWEST, apis: tuple[str, ...] = ()) -> dict[str, Object]:
    """What is rendered, by `KIND/NAME`, without the release's name before it."""
    found: dict[str, Object] = {}
    for name, text in files(values, kube, apis).items():
        for one in yaml.load_all(text, Loader=yaml.CSafeLoader) if name != "NOTES.txt" else ():
            if one is not None:
                key = f"{one['kind']}/{one['metadata']['name'].removeprefix('ns-').removeprefix('demo-skytether-')}"
                if one["metadata"].get("namespace", "ns") != "ns":
                    key += f"@{one['metadata']['namespace']}"
                assert key not in found, f"{key} is there twice"
                found[key] = one
    return found


def faults(one: Object, kube: str) -> list[str]:
    """What a strict API server of this version (`1.25`) would refuse an object for."""
    found = _validator(one["kind"], one["apiVersion"], kube).iter_errors(one)
    return [f"{error.json_path}: {error.message}" for error in found]


@cache
def _validator(kind: str, version: str, kube: str) -> Draft202012Validator:
    """`kubernetes_validate.validate` reads megabytes at each call."""
    group = re.sub(r"^([^./]*)(?:\.[^/]*)?/", r"\1-", version)
    return Draft202012Validator(_schema(f"{kind.lower()}-{group}.json", kube), registry=_definitions(kube))


def _schema(name: str, kube: str) -> Any:
    folder = importlib.resources.files("kubernetes_validate") / "kubernetes-json-schema" / f"v{kube}.0-local-strict"
    return json.loads((folder / name).read_text())


@cache
def _definitions(kube: str) -> Registry:
    return Resource.from_contents(_schema("_definitions.json", kube)) @ Registry()


def at(node: Any, path: str) -> Any:
    """What is at a path: keys with blanks between them, in lists numbers or the `name` of what is meant."""
    for key in path.split():
        if isinstance(node, list):
            named = [one for one in node if isinstance(one, dict) and one.get("name") == key]
            node = node[int(key)] if key.isdigit() and int(key) < len(node) else next(iter(named), ABSENT)
        else:
            node = node.get(key, ABSENT) if isinstance(node, dict) else ABSENT
    return node
