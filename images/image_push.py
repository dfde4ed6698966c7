"""``images/build.py --push``: images of the engine into a registry, for several architectures under one tag."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import docker
import yaml
from image_layers import Manifest, Packer, attached, index
from image_registry import Registry, digest_of, split

_SERVICES = Path(__file__).resolve().parent.parent / "services" / "skytether_services"
SBOM = "application/vnd.cyclonedx+json"
_REVISION = "org.opencontainers.image.revision"


@dataclass(frozen=True)
class Pushed:
    """One image in the registry.

    Attributes:
        image: Its name there, without tag.
        tags: All of these point at ``digest``.
        digest: Names it for sites with ``pinned``, whatever their architecture.
        platforms: By platform: the ``digest`` there, the ``id`` that an engine shows, the digest of its ``sbom``.
        replaced: Platforms that the tag had from another commit, and has no more.
    """

    image: str
    tags: tuple[str, ...]
    digest: str
    platforms: dict[str, dict[str, str]]
    replaced: tuple[str, ...]


class Pusher:
    """Brings images into a registry; tags point at them when all are there."""

    def __init__(self, client: docker.DockerClient, where: str, folder: Path) -> None:
        host, self._folder = split(where)
        self._client = client
        self._registry = Registry(host)
        self._temporary = folder
        self._packer = Packer(folder)
        self._made: dict[str, dict[str, tuple[Manifest, Manifest]]] = {}

    def close(self) -> None:
        """End the registry's connections."""
        self._registry.close()

    def repository(self, name: str) -> str:
        """An image's name within its registry."""
        return f"{self._folder}/{name}".lstrip("/")

    def image(self, name: str) -> str:
        """An image's full name there, without tag."""
        return f"{self._registry.host}/{self.repository(name)}"

    def check(self, names: Iterable[str]) -> None:
        """Whether these may be pushed, before anything is built."""
        for name in names:
            self._registry.check(self.repository(name))

    def push(self, name: str, local: str, foundation: Iterable[str]) -> Manifest:
        """Bring the engine's image ``local`` there, without a tag.

        Args:
            name: Its name there.
            local: Its name on the engine.
            foundation: The layers that stay as they are, byte by byte: Debian's.
        """
        saved = self._temporary / "saved.tar"
        with saved.open("wb") as file:
            for chunk in self._client.api.get_image(local):
                file.write(chunk)
        made = self._packer.image(saved, frozenset(foundation))
        saved.unlink()
        self._put(name, made)
        return made

    def attach(self, name: str, image: Manifest, platform: str, bill: Mapping[str, object]) -> None:
        """Bring the list of an image's packages there, so that it is found from the image."""
        document = attached(image, SBOM, (json.dumps(bill, indent=1) + "\n").encode())
        self._put(name, document)
        self._made.setdefault(name, {})[platform] = (image, document)

    def tag(self, name: str, tags: Iterable[str]) -> Pushed:
        """Let tags point at what was pushed for all platforms.

        Platforms that the first tag has of the same commit stay: each may be built on a machine of its kind.
        """
        tags, repository, made = tuple(tags), self.repository(name), self._made[name]
        (first, _), *_ = made.values()
        annotations = json.loads(first.body)["annotations"]
        known = self._registry.manifest(repository, tags[0]) or {}
        others = [row for row in known.get("manifests", []) if _platform(row) not in made]
        revision = annotations.get(_REVISION, "-dirty")
        same = not revision.endswith("-dirty") and known.get("annotations") == annotations
        rows = [image.descriptor(platform=_parts(platform)) for platform, (image, _) in made.items()]
        body = index(rows + (others if same else []), annotations)
        for one in tags:
            self._registry.put_tag(repository, one, body)
        platforms = {_platform(row): {"digest": str(row["digest"])} for row in others if same}
        for platform, (image, sbom) in made.items():
            platforms[platform] = {"digest": image.digest, "id": image.config, "sbom": sbom.digest}
        lost = () if same else tuple(_platform(row) for row in others)
        return Pushed(self.image(name), tags, digest_of(body), dict(sorted(platforms.items())), lost)

    def _put(self, name: str, made: Manifest) -> None:
        for digest, content in made.blobs.items():
            self._registry.put_blob(self.repository(name), digest, content)
        self._registry.put_manifest(self.repository(name), made.body)


def values(rows: Iterable[Pushed]) -> dict[str, object]:
    """What the chart is told: the orchestrator's image, and of each service its manifest with the image; by digest."""
    found: dict[str, object] = {}
    catalog: dict[str, object] = {}
    for row in rows:
        name = row.image.rpartition("/")[2]
        manifest = _SERVICES / name.replace("-", "_") / "service.yaml"
        if name == "orchestrator":
            found["image"] = {"repository": row.image, "tag": row.tags[0], "digest": row.digest}
        elif manifest.exists():
            document = yaml.safe_load(manifest.read_text())
            document["spec"]["image"] = f"{row.image}@{row.digest}"
            catalog[name] = document
    return found | ({"catalog": catalog} if catalog else {})


def _platform(row: Mapping[str, object]) -> str:
    parts = row.get("platform")
    return f"{parts.get('os')}/{parts.get('architecture')}" if isinstance(parts, dict) else "?"


def _parts(platform: str) -> dict[str, str]:
    system, _, architecture = platform.partition("/")
    return {"os": system, "architecture": architecture}
