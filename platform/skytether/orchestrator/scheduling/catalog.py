"""The services that robots can ask for: built-in ones, those of a folder, those that were PUT; the last wins."""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from skytether.api.manifest import Manifest
from skytether.api.rest import Change
from skytether.api.validation_errors import known
from skytether.api.yaml import YamlError, read_yaml

from ..config.settings import CatalogScope as Allowed
from ..domain.errors import ConflictError, Fault, ForbiddenError, InvalidError, NotFoundError
from ..domain.validation import check_schema, parse
from ..store.store import Store

log = logging.getLogger(__name__)

SERVICES = "skytether.services"
MANIFEST = "service.yaml"


def parse_manifest(document: Any, what: str = "") -> Manifest:
    """Validate a manifest.

    Raises:
        InvalidError: With each wrong key; ``what`` names the document.
    """
    manifest = parse(Manifest, document, what)
    try:
        check_schema(manifest.spec.params, "spec.params")
    except InvalidError as error:
        raise InvalidError(error.faults, what) from None
    return manifest


def read_manifest(path: Path) -> Manifest:
    """Read one from a YAML file.

    Raises:
        InvalidError: It cannot be read, is no YAML, or has wrong keys; the text begins with the path.
    """
    try:
        documents = read_yaml(path)
    except YamlError as error:
        raise InvalidError([Fault("", str(error))]) from None
    if len(documents) != 1:
        raise InvalidError([Fault("", f"holds {len(documents)} documents, not one manifest")], str(path))
    return parse_manifest(documents[0], str(path))


def read_folder(folder: Path) -> dict[str, Manifest]:
    """All manifests of a folder (``*.yaml``, ``*.yml``), by name.

    Raises:
        InvalidError: One of them is wrong, two have the same name, or the folder cannot be read.
    """
    if not folder.is_dir():
        raise InvalidError([Fault("", "there is no such folder")], str(folder))
    found: dict[str, Manifest] = {}
    for path in sorted(p for p in folder.iterdir() if p.suffix in (".yaml", ".yml")):
        manifest = read_manifest(path)
        if manifest.metadata.name in found:
            twice = f"another file has a service '{manifest.metadata.name}' too"
            raise InvalidError([Fault("metadata.name", twice)], str(path))
        found[manifest.metadata.name] = manifest
    return found


def read_builtin(points: Iterable[EntryPoint]) -> tuple[dict[str, Manifest], dict[str, str]]:
    """Manifests of installed services, and why others cannot be used, by name.

    A service's module is located, not imported: what it needs may be missing on this machine, and is not needed here.
    One that is broken must not keep the others, and the orchestrator, from working.
    """
    good, broken = {}, {}
    for point in points:
        try:
            manifest = read_manifest(_manifest_path(point))
        except InvalidError as error:
            broken[point.name] = str(error)
            continue
        if manifest.metadata.name != point.name:
            broken[point.name] = f"its manifest calls it '{manifest.metadata.name}'"
            continue
        good[point.name] = manifest
    return good, broken


def _manifest_path(point: EntryPoint) -> Path:
    try:
        spec = importlib.util.find_spec(point.module)
    except ImportError as error:
        raise InvalidError([Fault("", f"module {point.module} cannot be found: {error}")]) from error
    if spec is None or not spec.submodule_search_locations:
        raise InvalidError([Fault("", f"there is no package {point.module}")])
    return Path(next(iter(spec.submodule_search_locations))) / MANIFEST


class Catalog:
    """All services by name."""

    def __init__(self, store: Store, allowed: Allowed | None = None) -> None:
        """``allowed``: what others than the operator of the state folder may have run."""
        self._store = store
        self._allowed = allowed or Allowed()
        self._fixed: dict[str, Manifest] = {}
        self._broken: Mapping[str, str] = {}
        self._parsed: dict[str, tuple[dict[str, Any], Manifest]] = {}
        """By name, what was stored when it was read last: the reconciler reads all again and again."""

    def load(self, folder: Path | None) -> None:
        """Read what is installed, and the folder.

        Raises:
            InvalidError: The folder or one of its files is wrong.
        """
        builtin, self._broken = read_builtin(entry_points(group=SERVICES))
        for name, why in self._broken.items():
            log.warning("service %s is installed but cannot be used: %s", name, why)
        self._fixed = builtin | (read_folder(folder) if folder else {})

    def all(self) -> list[Manifest]:
        """By name."""
        return [manifest for _, manifest in sorted((self._fixed | self._stored()).items())]

    def _stored(self) -> dict[str, Manifest]:
        """Those that were put; parsed anew where they changed."""
        before, now = self._parsed, {}
        for name, document in self._store.services().items():
            read = before.get(name)
            now[name] = read if read and read[0] == document else (document, Manifest.model_validate(document))
        self._parsed = now
        return {name: manifest for name, (_, manifest) in now.items()}

    def get(self, name: str) -> Manifest:
        """One service.

        Raises:
            NotFoundError: There is none of that name; the text names those there are.
        """
        stored = self._stored().get(name)
        if stored is not None:
            return stored
        if name in self._fixed:
            return self._fixed[name]
        if name in self._broken:
            raise NotFoundError(f"service '{name}' is installed but cannot be used: {self._broken[name]}")
        raise NotFoundError(f"there is no service '{name}'; {known((m.metadata.name for m in self.all()), name)}")

    def put(self, name: str, manifest: Manifest, *, dry_run: bool = False, by_owner: bool = True) -> Change:
        """Add a service or change it for instances to come; with ``dry_run`` only say what that would do.

        Args:
            name: The service's.
            manifest: What it is to be.
            dry_run: Store nothing.
            by_owner: By the operator of the state folder, who may have anything run.

        Raises:
            ForbiddenError: Somebody else names a module or an image that is not allowed.
            InvalidError: Its name is another one, or its parameters' schema is none.
        """
        if manifest.metadata.name != name:
            raise InvalidError(
                [Fault("metadata.name", f"is '{manifest.metadata.name}', but the address says '{name}'")]
            )
        if not by_owner:
            self._check_allowed(manifest)
        check_schema(manifest.spec.params, "spec.params")
        document = manifest.model_dump(mode="json", by_alias=True)
        stored, fixed = self._store.services().get(name), self._fixed.get(name)
        if document == stored or (stored is None and manifest == fixed):
            return Change.UNCHANGED
        if not dry_run:
            self._store.put_service(name, document)
        return Change.CREATED if stored is None and fixed is None else Change.CHANGED

    def _check_allowed(self, manifest: Manifest) -> None:
        module, image = manifest.spec.entrypoint, manifest.spec.image
        # With its launch file: that says what a graph's module starts.
        runs = {(known.spec.entrypoint, known.spec.launch) for known in self._fixed.values()}
        if module is not None and module not in self._allowed.modules and (module, manifest.spec.launch) not in runs:
            launching = f" with the launch file '{manifest.spec.launch}'" if manifest.spec.launch else ""
            raise ForbiddenError(
                f"this token may not have the module '{module}' run{launching}: name one of an installed service, add "
                "the module to the orchestrator's catalog.modules, or use the token in its state folder"
            )
        if image is not None and not any(fnmatchcase(image, pattern) for pattern in self._allowed.images):
            raise ForbiddenError(
                f"this token may not have the image '{image}' run: the orchestrator's catalog.images are "
                f"{', '.join(self._allowed.images) or '(none)'}"
            )

    def delete(self, name: str) -> None:
        """Remove a service that was put; what runs of it runs on. One that is gone already is no error.

        Raises:
            ConflictError: It is built in, or comes from the folder.
        """
        if name in self._store.services():
            self._store.delete_service(name)
        elif name in self._fixed:
            raise ConflictError(f"service '{name}' is built in or comes from the catalog folder: it is removed there")
