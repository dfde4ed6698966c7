"""An image of the engine as a registry keeps it: the same bytes from the same files, whenever it was built.

The engine notes when it made each layer, and gives the folders that it makes the time of the day; a layer's files have
times of their own where the build has written them. Here all of these times are left out.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import json
import posixpath
import shutil
import tarfile
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import IO, Any

from image_registry import INDEX, MANIFEST, digest_of

_CONFIG = "application/vnd.oci.image.config.v1+json"
_LAYER = "application/vnd.oci.image.layer.v1.tar+gzip"
_EMPTY = "application/vnd.oci.empty.v1+json"
BUILT_WITHIN_S = 3600
"""A file that is at most so much older than its layer was written by the build. One from a package is older: it was
packed, then published."""


@dataclass(frozen=True)
class Manifest:
    """One manifest, and the blobs it refers to by their digests.

    Attributes:
        body: Its bytes.
        blobs: What they are, or the files that have them.
    """

    body: bytes
    blobs: Mapping[str, bytes | Path]

    @property
    def digest(self) -> str:
        """Its name."""
        return digest_of(self.body)

    @property
    def config(self) -> str:
        """The digest of its configuration: the image's id on an engine that pulls it."""
        return str(json.loads(self.body)["config"]["digest"])

    def descriptor(self, **more: object) -> dict[str, object]:
        """What refers to it says this."""
        return {"mediaType": MANIFEST, "digest": self.digest, "size": len(self.body)} | more


@dataclass(frozen=True)
class _Layer:
    diff_id: str
    digest: str
    path: Path


class Packer:
    """Packs images; what they share once."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._layers: dict[str, _Layer] = {}

    def image(self, saved: Path, foundation: frozenset[str]) -> Manifest:
        """The image in a file of ``docker save``. It says that it was made when its label ``created`` says so.

        Args:
            saved: The file.
            foundation: The layers (by the digest of what they hold) that stay as they are, byte by byte: Debian's.
        """
        with tarfile.open(saved) as tar:
            (listed,) = json.loads(_content(tar, "manifest.json").read())
            config = json.loads(_content(tar, listed["Config"]).read())
            steps = [row for row in config["history"] if not row.get("empty_layer")]
            layers = []
            for name, diff_id, step in zip(listed["Layers"], config["rootfs"]["diff_ids"], steps, strict=True):
                if diff_id not in self._layers:
                    since = None if diff_id in foundation else _seconds(step["created"]) - BUILT_WITHIN_S
                    self._layers[diff_id] = self._pack(_content(tar, name), since)
                layers.append(self._layers[diff_id])
        labels = config["config"].get("Labels") or {}
        created = labels.get("org.opencontainers.image.created", "1970-01-01T00:00:00Z")
        plain = _encoded(_plain(config, [layer.diff_id for layer in layers], created))
        body = {
            "schemaVersion": 2,
            "mediaType": MANIFEST,
            "config": {"mediaType": _CONFIG, "digest": digest_of(plain), "size": len(plain)},
            "layers": [
                {"mediaType": _LAYER, "digest": layer.digest, "size": layer.path.stat().st_size} for layer in layers
            ],
            "annotations": {key: labels[key] for key in sorted(labels) if key.startswith("org.opencontainers.image.")},
        }
        blobs: dict[str, bytes | Path] = {layer.digest: layer.path for layer in layers}
        return Manifest(_encoded(body), blobs | {digest_of(plain): plain})

    def _pack(self, content: IO[bytes], since: float | None) -> _Layer:
        path = self._folder / f"layer-{len(self._layers)}"
        with path.open("wb") as file:
            packed = _Hashed(file)
            with gzip.GzipFile(filename="", mode="wb", fileobj=packed, compresslevel=6, mtime=0) as stream:
                plain = _Hashed(stream)
                with _unpacked(content) as source:
                    if since is None:
                        shutil.copyfileobj(source, plain)
                    else:
                        without_times(source, plain, since)
        return _Layer(plain.digest, packed.digest, path)


def without_times(source: IO[bytes], target: Any, since: float) -> None:
    """Copy a tar file; what was written at ``since`` or later (Unix time) gets the time 0.

    Older files keep theirs: the byte code that comes with them names it.
    """
    with (
        tarfile.open(fileobj=source, mode="r:") as old,
        tarfile.open(fileobj=target, mode="w", format=tarfile.PAX_FORMAT) as new,
    ):
        for entry in old:
            entry.mtime = 0 if entry.mtime >= since else int(entry.mtime)
            times = ("mtime", "atime", "ctime")
            entry.pax_headers = {key: said for key, said in entry.pax_headers.items() if key not in times}
            new.addfile(entry, old.extractfile(entry) if entry.isreg() else None)


def index(manifests: list[dict[str, object]], annotations: Mapping[str, str]) -> bytes:
    """What a tag points at: one image for several platforms."""
    rows = sorted(manifests, key=lambda row: json.dumps(row["platform"], sort_keys=True))
    return _encoded({"schemaVersion": 2, "mediaType": INDEX, "manifests": rows, "annotations": dict(annotations)})


def attached(subject: Manifest, kind: str, content: bytes) -> Manifest:
    """A document about an image: it names the image as its subject."""
    body = {
        "schemaVersion": 2,
        "mediaType": MANIFEST,
        "artifactType": kind,
        "config": {"mediaType": _EMPTY, "digest": digest_of(b"{}"), "size": 2},
        "layers": [{"mediaType": kind, "digest": digest_of(content), "size": len(content)}],
        "subject": subject.descriptor(),
    }
    return Manifest(_encoded(body), {digest_of(b"{}"): b"{}", digest_of(content): content})


def _plain(config: dict[str, Any], diff_ids: list[str], created: str) -> dict[str, Any]:
    """An image's configuration without the day it was built on, and the container it was built in."""
    built = {"Image", "Hostname", "Domainname"}
    kept = {key: config[key] for key in ("architecture", "os", "variant", "author") if config.get(key)}
    return kept | {
        "created": created,
        "config": {key: value for key, value in config["config"].items() if value and key not in built},
        "rootfs": {"type": "layers", "diff_ids": diff_ids},
        "history": [row | {"created": created} for row in config["history"]],
    }


def _encoded(document: Mapping[str, Any]) -> bytes:
    return json.dumps(document, sort_keys=True, separators=(",", ":")).encode()


def _content(tar: tarfile.TarFile, name: str) -> IO[bytes]:
    """A file of a saved image; a layer that is there already may be a link to it."""
    entry = tar.getmember(name)
    if entry.issym():
        return _content(tar, posixpath.normpath(posixpath.join(posixpath.dirname(name), entry.linkname)))
    found = tar.extractfile(entry)
    if found is None:
        raise KeyError(name)
    return found


def _unpacked(content: IO[bytes]) -> IO[bytes]:
    """A layer's tar file; engines with containerd's store save it as it was pulled."""
    packed = content.read(2) == b"\x1f\x8b"
    content.seek(0)
    return gzip.GzipFile(fileobj=content) if packed else content  # type: ignore[return-value]


def _seconds(time: str) -> float:
    """Unix time."""
    return datetime.fromisoformat(time).timestamp()


class _Hashed(io.RawIOBase):
    """Passes on what is written to it."""

    def __init__(self, target: Any) -> None:
        self._target = target
        self._sum = hashlib.sha256()
        self._at = 0

    def write(self, content: Any) -> int:
        self._sum.update(content)
        self._target.write(content)
        self._at += len(content)
        return len(content)

    def tell(self) -> int:
        return self._at

    def writable(self) -> bool:
        return True

    @property
    def digest(self) -> str:
        """Of all that was written."""
        return f"sha256:{self._sum.hexdigest()}"
