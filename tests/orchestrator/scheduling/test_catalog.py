from __future__ import annotations

import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest
import yaml

from skytether.api.rest import Change
from skytether.orchestrator.domain.errors import ConflictError, InvalidError, NotFoundError
from skytether.orchestrator.scheduling.catalog import Catalog, parse_manifest, read_builtin, read_folder
from skytether.orchestrator.store.store import Store


def package(folder: Path, name: str, text: str | None, init: str = "raise SystemExit('imported')") -> EntryPoint:
    """An importable package; importing it is an error."""
    (folder / name).mkdir()
    (folder / name / "__init__.py").write_text(init)
    if text is not None:
        (folder / name / "service.yaml").write_text(text)
    return EntryPoint(name.replace("_", "-"), name, "skytether.services")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def test_built_in_services_are_found_without_importing_them(folder: Path, manifest: Any) -> None:
    point = package(folder, "cat_good", yaml.safe_dump(manifest("cat-good")))
    good, broken = read_builtin([point])
    assert list(good) == ["cat-good"]
    assert broken == {}
    assert "cat_good" not in sys.modules


def test_a_broken_built_in_service_says_why_and_keeps_no_other_from_working(folder: Path, manifest: Any) -> None:
    points = [
        package(folder, "cat_fine", yaml.safe_dump(manifest("cat-fine"))),
        package(folder, "cat_none", None),
        package(folder, "cat_typo", yaml.safe_dump(manifest("cat-typo", entrypiont="x"))),
        package(folder, "cat_name", yaml.safe_dump(manifest("another"))),
        EntryPoint("cat-gone", "cat_gone", "skytether.services"),
        EntryPoint("cat-deep", "cat_gone.deep", "skytether.services"),
    ]
    good, broken = read_builtin(points)
    assert list(good) == ["cat-fine"]
    assert "cannot be read: No such file" in broken["cat-none"]
    assert "spec.entrypiont: unknown key, did you mean 'entrypoint'?" in broken["cat-typo"]
    assert broken["cat-name"] == "its manifest calls it 'another'"
    assert broken["cat-gone"] == "there is no package cat_gone"
    assert "cat_gone" in broken["cat-deep"]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("a: [1", "is no YAML in line 1"),
        ("\0", "is no YAML"),
        ("- 1", "must be a mapping of keys to values"),
        ("kind: Service", "apiVersion: is missing"),
    ],
)
def test_a_folders_wrong_file_is_named(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "x.yaml").write_text(text)
    with pytest.raises(InvalidError) as caught:
        read_folder(tmp_path)
    assert str(caught.value).startswith(f"{tmp_path / 'x.yaml'}: ")
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_folder_is_read_whole_and_a_name_may_come_once(tmp_path: Path, manifest: Any) -> None:
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(manifest("a")))
    (tmp_path / "b.yml").write_text(yaml.safe_dump(manifest("b")))
    (tmp_path / "notes.txt").write_text("no manifest")
    assert list(read_folder(tmp_path)) == ["a", "b"]
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(manifest("a")))
    with pytest.raises(InvalidError, match="another file has a service 'a' too"):
        read_folder(tmp_path)
    with pytest.raises(InvalidError, match="there is no such folder"):
        read_folder(tmp_path / "nowhere")


def test_what_was_put_goes_before_the_folder_and_uncovers_it_when_deleted(
    tmp_path: Path, store: Store, manifest: Any
) -> None:
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(manifest("a", entrypoint="folder")))
    catalog = Catalog(store)
    catalog.load(tmp_path)
    assert catalog.put("a", parse_manifest(manifest("a", entrypoint="folder"))) is Change.UNCHANGED
    changed = parse_manifest(manifest("a", entrypoint="put"))
    assert catalog.put("a", changed, dry_run=True) is Change.CHANGED
    assert catalog.get("a").spec.entrypoint == "folder"
    assert catalog.put("a", changed) is Change.CHANGED
    assert catalog.put("a", changed) is Change.UNCHANGED
    assert catalog.put("b", parse_manifest(manifest("b")), dry_run=True) is Change.CREATED
    assert catalog.put("b", parse_manifest(manifest("b"))) is Change.CREATED
    assert catalog.get("a").spec.entrypoint == "put"
    assert {"a", "b"} <= {m.metadata.name for m in catalog.all()}
    catalog.delete("a")
    assert catalog.get("a").spec.entrypoint == "folder"
    with pytest.raises(ConflictError, match="built in or comes from the catalog folder"):
        catalog.delete("a")
    catalog.delete("b")
    catalog.delete("b")
    with pytest.raises(NotFoundError, match="there is no service 'b'; known are: a, "):
        catalog.get("b")


def test_a_service_is_put_under_its_own_name_with_a_schema_that_is_one(store: Store, manifest: Any) -> None:
    catalog = Catalog(store)
    with pytest.raises(InvalidError, match=r"metadata\.name: is 'a', but the address says 'b'"):
        catalog.put("b", parse_manifest(manifest("a")))
    with pytest.raises(InvalidError, match=r"spec\.params\.type"):
        parse_manifest(manifest("a", params={"type": "objekt"}))
