"""``skytether apply``: services as files say, all of them or none."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from ..connection import Json, TokenFile, Url, connected
from ..output import console, fail, fail_all, print_json

if TYPE_CHECKING:
    from skytether.api.client import Client
    from skytether.api.rest import Change

_COLOURS = {"created": "green", "changed": "yellow", "unchanged": "dim"}


class _Document(NamedTuple):
    where: str
    name: str
    content: Any


def apply(
    file: Annotated[
        list[Path],
        typer.Option(
            "--file",
            "-f",
            help="YAML of one or more manifests: a file, a folder of *.yaml and *.yml, or - for standard input; "
            "may be given again.",
        ),
    ],
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only look: say what would be created or changed.")
    ] = False,
    url: Url = None,
    token_file: TokenFile = None,
    json: Json = False,
) -> None:
    """Make the catalog's services as the files say: created, changed or left as they are. May be run again.

    All are looked at before the first is stored: if one is wrong, none is.
    """
    documents = _read(file)
    with connected(url, token_file) as client:
        looked = _dry_run(client, documents)
        done = looked if dry_run else _store(client, documents)
    if json:
        print_json([{**manifest, "result": change} for manifest, change in done])
        return
    for document, (manifest, change) in zip(documents, done, strict=True):
        version = manifest["metadata"]["version"]
        console.print(f"[{_COLOURS[change]}]{change:>9}[/]  service {document.name}, version {version}")


def _dry_run(client: Client, documents: list[_Document]) -> list[tuple[Any, Change]]:
    """Have the orchestrator check all of them; ends with every sentence on what is wrong."""
    from skytether.api.client import ApiError

    found, wrong = [], []
    for document in documents:
        try:
            found.append(_put(client, document, dry_run=True))
        except ApiError as error:
            if error.problem.status != 422:
                raise
            wrong.append(f"{document.where}: {error}")
    if wrong:
        fail_all(wrong)
    return found


def _store(client: Client, documents: list[_Document]) -> list[tuple[Any, Change]]:
    from skytether.api.client import ApiError, Unreachable

    done: list[tuple[Any, Change]] = []
    for document in documents:
        try:
            done.append(_put(client, document))
        except (ApiError, Unreachable) as error:
            before = ", ".join(d.name for d in documents[: len(done)]) or "none"
            fail(f"{document.where}: {error} (applied before: {before}; apply again)")
    return done


def _put(client: Client, document: _Document, *, dry_run: bool = False) -> tuple[Any, Change]:
    manifest, change = client.apply_service(document.name, document.content, dry_run=dry_run)
    return manifest.model_dump(mode="json", by_alias=True), change


def _read(files: list[Path]) -> list[_Document]:
    """All documents of all files, each with a name of its own; ends with every sentence on what is wrong."""
    from skytether.api.manifest import NAME
    from skytether.api.yaml import YamlError

    documents: list[_Document] = []
    wrong: list[str] = []
    for file in [one for given in files for one in _expand(given)]:
        try:
            contents = _contents(file)
        except YamlError as error:
            wrong.append(str(error))
            continue
        shown = "standard input" if str(file) == "-" else str(file)
        if not contents:
            wrong.append(f"{shown} holds no manifest")
        for number, content in enumerate(contents, 1):
            where = shown if len(contents) == 1 else f"{shown}, document {number}"
            name = _name(content)
            twin = next((d.where for d in documents if d.name == name), None)
            if name is None:
                wrong.append(f"{where}: metadata.name: is missing")
            elif not NAME.fullmatch(name):
                wrong.append(f"{where}: metadata.name: '{name}' is not a valid name: a-z, digits and '-', at most 63")
            elif twin is not None:
                wrong.append(f"{where}: service '{name}' is in {twin} already")
            else:
                documents.append(_Document(where, name, content))
    if wrong:
        fail_all(wrong, 2)
    return documents


def _contents(file: Path) -> list[Any]:
    from skytether.api.yaml import MAX_BYTES, parse_yaml, read_yaml

    if str(file) == "-":
        return parse_yaml(sys.stdin.buffer.read(MAX_BYTES + 1), Path("standard input"))
    return read_yaml(file)


def _expand(given: Path) -> list[Path]:
    if not given.is_dir():
        return [given]
    found = sorted(path for path in given.iterdir() if path.suffix in (".yaml", ".yml"))
    if not found:
        fail(f"{given} holds no *.yaml and no *.yml", 2)
    return found


def _name(document: Any) -> str | None:
    metadata = document.get("metadata") if isinstance(document, dict) else None
    name = metadata.get("name") if isinstance(metadata, dict) else None
    return name if isinstance(name, str) and name else None
