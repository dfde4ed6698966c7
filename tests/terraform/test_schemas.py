"""Names in `terraform/` are those of the providers, as far as their bindings know them."""

from __future__ import annotations

import importlib.util
import json
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

pytestmark = pytest.mark.slow  # python-hcl2 takes its time

ROOT = Path(__file__).parents[2]
SCHEMAS = Path(__file__).parent / "schemas"
FILES = sorted((ROOT / "terraform").rglob("*.tf"))
META = {"count", "for_each", "depends_on", "provider", "lifecycle", "provisioner", "connection"}
PROVIDERS = ("aws", "google", "openstack")


@cache
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("provider_schemas", ROOT / ".ci" / "provider_schemas.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@cache
def schema(provider: str) -> Any:
    return json.loads((SCHEMAS / f"{provider}.json").read_text())


def faults(body: dict[str, Any], known: dict[str, Any], where: str) -> Iterator[str]:
    """Attributes and blocks that are not there, and those that are missing."""
    given = {key for key in body if not key.startswith("__")} - META
    dynamic = {key.strip('"'): inner for one in body.get("dynamic", ()) for key, inner in one.items()}
    for key in given - {"dynamic"}:
        if key in known["blocks"]:
            for inner in body[key]:
                yield from faults(inner, known["blocks"][key], f"{where}.{key}")
        elif key not in known["attributes"]:
            yield f"{where} has no {key}"
    for key, inner in dynamic.items():
        if key not in known["blocks"]:
            yield f"{where} has no block {key}"
        else:
            for content in inner["content"]:
                yield from faults(content, known["blocks"][key], f"{where}.{key}")
    yield from (
        f"{where} wants {key}" for key, type_ in known["attributes"].items() if type_.endswith("!") and key not in given
    )
    yield from (
        f"{where} wants a block {key}"
        for key, one in known["blocks"].items()
        if one["required"] and key not in {*given, *dynamic}
    )


def of_file(file: Path) -> Iterator[str]:
    text = file.read_text()
    for kind in ("resource", "data"):
        for type_, name, body in script().blocks(text, kind):
            provider = type_.partition("_")[0]
            if provider in PROVIDERS:
                yield from faults(body, schema(provider)[kind][type_], f"{file.parent.name}: {type_}.{name}")
    # What is read of them: `aws_eip.node["one"].public_ip`.
    for data, type_, attribute in re.findall(
        rf"\b(data\.)?((?:{'|'.join(PROVIDERS)})_\w+)\.\w+(?:\[[^][]*(?:\[[^][]*\][^][]*)*\])?\.(\w+)", text
    ):
        known = schema(type_.partition("_")[0])["data" if data else "resource"][type_]
        if attribute not in {*known["attributes"], *known["blocks"], *known["computed"], "id"}:
            yield f"{file.parent.name}: {type_} has no {attribute} to read"


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(ROOT / "terraform")))
def test_each_name_is_the_providers(file: Path) -> None:
    assert list(of_file(file)) == []


def test_a_wrong_name_is_found(tmp_path: Path) -> None:
    file = tmp_path / "main.tf"
    file.write_text(
        """
        resource "google_compute_address" "a" {
          nam = "a"
        }
        resource "google_compute_firewall" "b" {
          name    = "b"
          network = google_compute_address.a["x"].adress
          alow {
            protocol = "tcp"
          }
        }
        resource "google_compute_instance" "c" {
          name         = "c"
          machine_type = "t"
          boot_disk {
            disk_size = 1
          }
        }
        """
    )
    found = {fault.partition(": ")[2] for fault in of_file(file)}
    assert found == {
        "google_compute_address.a has no nam",
        "google_compute_address.a wants name",
        "google_compute_firewall.b has no alow",
        "google_compute_address has no adress to read",
        "google_compute_instance.c.boot_disk has no disk_size",
        "google_compute_instance.c wants a block network_interface",
    }


def test_the_extracts_are_of_what_is_used_and_of_versions_that_the_modules_take() -> None:
    kept = {
        (kind, type_) for provider in PROVIDERS for kind in ("resource", "data") for type_ in schema(provider)[kind]
    }
    assert kept == script().used(), "run `python .ci/provider_schemas.py`"
    for provider in PROVIDERS:
        assert schema(provider)["package"] == script().PACKAGES[provider]
        version = tuple(int(part) for part in schema(provider)["version"].split("."))
        wanted = [
            entry[provider]
            for file in FILES
            for block in script().parsed(file.read_text()).get("terraform", ())
            for entry in block.get("required_providers", ())
            if provider in entry
        ]
        assert wanted
        for one in wanted:
            assert one["source"].strip('"') == schema(provider)["source"]
            least, below = re.findall(r"(?:>=|<) ([\d.]+)", one["version"])
            assert tuple(map(int, least.split("."))) <= version < tuple(map(int, below.split(".")))


def test_the_pages_are_of_what_is_there() -> None:
    spec = importlib.util.spec_from_file_location("terraform_docs", ROOT / ".ci" / "terraform_docs.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    pages = dict(module.pages())
    assert len(pages) == 11
    for path, text in pages.items():
        assert path.read_text() == text, f"{path.relative_to(ROOT)}: run `make docs`"
