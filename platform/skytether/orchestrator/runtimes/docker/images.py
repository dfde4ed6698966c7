"""A service's image on the engine: looked up, or pulled with progress."""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from docker.auth import AuthConfig, load_config, resolve_authconfig, resolve_repository_name
from docker.errors import APIError, DockerException, ImageNotFound, NotFound

from skytether.api.pull_progress import PullProgress

from ..base import RuntimeFailure
from ..containers import is_pulled
from .engine import Engine, explain
from .options import DockerOptions
from .signed import check

_PULL_SILENCE_S = 120.0
"""A registry that sends nothing for so long is given up."""


class _Layer(NamedTuple):
    """One of an image's layers: bytes, as they are sent."""

    size: int
    here: int
    unpacked: int = 0


class PullMeter:
    """How far a pull is, from the engine's messages. Pure."""

    def __init__(self, image: str) -> None:
        self._image = image
        self._layers: dict[str, _Layer] = {}

    def after(self, message: Mapping[str, Any]) -> PullProgress:
        """After one more message."""
        layer, detail = str(message.get("id")), message.get("progressDetail") or {}
        status, current = str(message.get("status", "")), int(detail.get("current") or 0)
        if status == "Downloading" and detail.get("total"):
            self._layers[layer] = _Layer(int(detail["total"]), current)
        elif layer in self._layers and status in ("Download complete", "Extracting", "Pull complete"):
            size = self._layers[layer].size
            unpacked = {"Extracting": min(current, size), "Pull complete": size}.get(status, 0)
            self._layers[layer] = _Layer(size, size, unpacked)
        layers = self._layers.values()
        total, here = sum(one.size for one in layers), sum(one.here for one in layers)
        unpacking = total > 0 and here >= total
        done = sum(one.unpacked for one in layers) if unpacking else here
        return PullProgress(image=self._image, unpacking=unpacking, done_bytes=done, total_bytes=total)


def check_credentials(path: str) -> None:
    """See that a file of credentials can be read, by its owner alone.

    Raises:
        RuntimeFailure: It cannot be used.
    """
    try:
        mode = os.stat(path).st_mode
        with open(path, "rb") as file:
            document = json.load(file)
    except OSError as error:
        raise RuntimeFailure(f"registry_auth {path}: {error.strerror}") from error
    except ValueError as error:
        raise RuntimeFailure(f"registry_auth {path} is no JSON: make it with `docker login`") from error
    if stat.S_IMODE(mode) & 0o077:
        raise RuntimeFailure(f"registry_auth {path} can be read by others: chmod 600 {path}")
    if not isinstance(document, dict) or not isinstance(document.get("auths", {}), dict):
        raise RuntimeFailure(f"registry_auth {path} has no 'auths': make it with `docker login`")


def ensure_image(
    engine: Engine,
    options: DockerOptions,
    image: str,
    on_progress: Callable[[PullProgress], None],
    *,
    by_digest: bool = False,
) -> str:
    """The id of an image that is on the engine, after a pull if need be.

    Args:
        engine: Where.
        options: The site's: when to pull, and with which credentials.
        image: As the manifest names it.
        on_progress: Called with each step of a pull.
        by_digest: Pull it only if its name holds its digest, whatever the name.

    Raises:
        EngineGoneError: The engine does not answer.
        RuntimeFailure: The image is missing and cannot be pulled, or nobody has signed it who must have.
    """
    found = _on_the_engine(engine, options, image, on_progress, by_digest=by_digest)
    if options.signatures is not None:
        check(image, found, options.signers, options.signatures)
    return found


def _on_the_engine(
    engine: Engine, options: DockerOptions, image: str, on_progress: Callable[[PullProgress], None], *, by_digest: bool
) -> str:
    may_pull = "@sha256:" in image if by_digest else is_pulled(image)
    if options.pull != "always" or not may_pull:
        found = _find(engine, image)
        if found is not None:
            return found
        if not may_pull:
            raise RuntimeFailure(
                f"image '{image}' is not on the engine, and is not pulled by this name, which anybody may have in a "
                "registry: build it (`make images`), or name it with its digest (NAME@sha256:...)"
            )
        if options.pull == "never":
            raise RuntimeFailure(f"image '{image}' is not on the engine, and the site's option 'pull' is never")
    _pull(engine, options, image, on_progress)
    found = _find(engine, image)
    if found is None:
        raise RuntimeFailure(f"image '{image}' was pulled, but is not on the engine")
    return found


def _find(engine: Engine, image: str) -> str | None:
    with engine.asked():
        try:
            return str(engine.api().inspect_image(image)["Id"])
        except (ImageNotFound, NotFound):
            return None


def _pull(engine: Engine, options: DockerOptions, image: str, on_progress: Callable[[PullProgress], None]) -> None:
    trouble = ""
    meter = PullMeter(image)
    on_progress(meter.after({}))
    with engine.asked():
        try:
            api = engine.api(_PULL_SILENCE_S)
            pinned = "@" in image or ":" in image.rpartition("/")[2]
            name = image if pinned else f"{image}:latest"  # or the engine would fetch every tag there is
            for message in api.pull(name, stream=True, decode=True, auth_config=_credentials(options, image)):
                on_progress(meter.after(message))
                trouble = str(message["error"]) if "error" in message else trouble
        except APIError as error:
            trouble = explain(error)
    if trouble:
        raise RuntimeFailure(f"image '{image}' is not on the engine and cannot be pulled: {trouble}")


def _credentials(options: DockerOptions, image: str) -> dict[str, Any] | None:
    """Those of the image's registry; empty: none, rather than any of the orchestrator's own user."""
    if options.registry_auth is None:
        return {}
    check_credentials(options.registry_auth)  # it may have changed
    try:
        known: AuthConfig = load_config(config_path=options.registry_auth)
        return resolve_authconfig(known, registry=resolve_repository_name(image)[0]) or {}
    except DockerException as error:
        raise RuntimeFailure(f"registry_auth {options.registry_auth}: {error}") from error
