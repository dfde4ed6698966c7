"""The values: documented, closed, and true to what is made of them."""

from __future__ import annotations

import json
import tarfile
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from helm_chart import CHART, ROOT, helm_python, objects, script

_FREE = {
    "ServiceSpec/properties/params": "a schema of parameters",
    "KubernetesOptions/properties/tolerations/items": "as the orchestrator takes them",
    "Site/properties/options": "the definitions of a runtime's options say more of it",
}
"""Objects with keys of anybody's, and what they are."""


def test_what_is_made_of_the_source_is_what_is_there() -> None:
    for path, text in script().files().items():
        assert path.read_text() == text, f"{path.name}: run `make docs`"


def test_helm_finds_no_fault() -> None:
    report = helm_python.lint(CHART, strict=True, kube_version="v1.20.0")
    assert report["total_charts_linted"] == 1
    assert [one for one in report["messages"] if "icon" not in one["error"]] == []


def test_every_value_says_what_it_means() -> None:
    rows = dict(script().leaves(script().source()))
    assert len(rows) > 100
    for name, one in rows.items():
        assert one.get("description", "").endswith((".", ")")), name
    page = (ROOT / "docs" / "helm-values.md").read_text()
    assert all(f"| `{name}` |" in page for name in rows)
    assert rows.keys() == set(_leaves(yaml.safe_load((CHART / "values.yaml").read_text()), rows))


def _leaves(node: dict[str, Any], known: dict[str, Any], above: str = "") -> Iterator[str]:
    for key, one in node.items():
        if above + key in known:
            yield above + key
        else:
            yield from _leaves(one, known, f"{above}{key}.")


def test_every_object_is_closed() -> None:
    document = json.loads((CHART / "values.schema.json").read_text())
    seen = list(_objects(document, ""))
    assert len(seen) > 150
    for path, one in seen:
        if path.endswith(tuple(_FREE)):
            continue
        others = one.get("additionalProperties")
        named = one.get("patternProperties") or one.get("propertyNames")
        assert others is False or (isinstance(others, dict) and others) or named, f"{path} takes any key"


def _objects(node: Any, path: str) -> Iterator[tuple[str, dict[str, Any]]]:
    if isinstance(node, list):
        for number, one in enumerate(node):
            yield from _objects(one, f"{path}/{number}")
    elif isinstance(node, dict):
        kind = node.get("type", ())
        whole = "/if" not in path and "/then" not in path  # these say more of an object that is closed
        if whole and (
            "object" in ([kind] if isinstance(kind, str) else kind) or isinstance(node.get("properties"), dict)
        ):
            yield path, node
        for key, one in node.items():
            if key not in ("enum", "const"):
                yield from _objects(one, f"{path}/{key}")


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"orchestator": {}}, "additional properties 'orchestator' not allowed"),
        ({"orchestrator": {"replica": 2}}, "at '/orchestrator': additional properties 'replica' not allowed"),
        ({"orchestrator": {"replicas": "two"}}, "at '/orchestrator/replicas': got string, want integer"),
        (
            {"orchestrator": {"service": {"type": "Loadbalancer"}}},
            "at '/orchestrator/service/type': value must be one of",
        ),
        ({"orchestrator": {"affinity": {"nodeAffinty": {}}}}, "at '/orchestrator/affinity'"),
        (
            {"orchestrator": {"volumes": [{"name": "a", "emptydir": {}}]}},
            "additional properties 'emptydir' not allowed",
        ),
        ({"orchestrator": {"env": [{"value": "a"}]}}, "missing property 'name'"),
        ({"image": {"digest": "sha256:12"}}, "at '/image/digest'"),
        ({"config": {"limits": {"body_byte": 1}}}, "additional properties 'body_byte' not allowed"),
        ({"config": {"state_dir": "/a"}}, "additional properties 'state_dir' not allowed"),
        ({"sites": {"cluster": {"options": {"reech": "pod"}}}}, "additional properties 'reech' not allowed"),
        ({"sites": {"a": {"tier": "edge", "runtime": "process"}}}, "at '/sites/a/runtime': value must be one of"),
        ({"sites": {"a": {"tier": "edge", "runtime": "docker", "options": {"reach": "pod"}}}}, "'reach' not allowed"),
        ({"sites": {"A": {"tier": "edge", "runtime": "docker"}}}, "invalid propertyName 'A'"),
        ({"catalog": {"a": {"spec": {"imag": "a"}}}}, "additional properties 'imag' not allowed"),
        ({"relay": {"config": {"upstraem": None, "routes": []}}}, "additional properties 'upstraem' not allowed"),
        ({"labels": {"a": 1}}, "at '/labels/a': got number, want string"),
        ({"gateway": {"parentRefs": [{"nam": "a"}]}}, "missing property 'name'"),
    ],
)
def test_a_typo_is_refused_by_name(values: dict[str, Any], says: str) -> None:
    with pytest.raises(helm_python.HelmError) as refused:
        objects(values)
    assert says in str(refused.value)


def test_version_and_note_are_those_of_the_release() -> None:
    about = script().metadata()
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert about["appVersion"] == version
    notes = [
        line.removeprefix("## ") for line in (CHART / "UPGRADING.md").read_text().splitlines() if line[:3] == "## "
    ]
    assert notes[0] == about["version"], "each release has an upgrade note"
    assert len(notes) == len(set(notes))


def test_what_is_packaged_holds_the_files_themselves(tmp_path: Path) -> None:
    archive = helm_python.package(CHART, destination=tmp_path)
    with tarfile.open(archive) as packed:
        names = {one.name.removeprefix("skytether/"): one for one in packed.getmembers()}
        assert all(one.isfile() for one in names.values())
        rules = packed.extractfile(names["files/rules.yml"])
        assert rules is not None
        assert rules.read() == (ROOT / "images" / "prometheus" / "rules.yml").read_bytes()
    assert {"Chart.yaml", "values.schema.json", "UPGRADING.md", "LICENSE", "files/dashboard.json"} <= names.keys()
