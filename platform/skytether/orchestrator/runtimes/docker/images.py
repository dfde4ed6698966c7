"""A service's image on the engine: looked up, or pulled with progress."""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Callable, Mapping
from typing import Any

from docker.auth import AuthConfig, load_config, resolve_authconfig, resolve_repository_name
from docker.errors import APIError, DockerException, ImageNotFound, NotFound

from ..base import RuntimeFailure
from .engine import Engine, explain
from .options import DockerOptions

_PULL_SILENCE_S = 120.0
"""A registry that sends nothing for so long is given up."""


class Progress:
    """How far a pull is, from the engine's messages. Pure."""

    def __init__(self, image: str) -> None:
        self._image = image
        self._layers: dict[str, tuple[int, int]] = {}

    def text(self, message: Mapping[str, Any]) -> str:
        """In words, after one more message."""
        layer, detail = message.get("id"), message.get("progressDetail") or {}
        status = str(message.get("status", ""))
        if layer and status == "Downloading" and detail.get("total"):
            self._layers[layer] = (int(detail.get("current", 0)), int(detail["total"]))
        elif layer in self._layers and status in ("Download complete", "Extracting", "Pull complete"):
            total = self._layers[layer][1]
            self._layers[layer] = (total, total)
        done = sum(current for current, _ in self._layers.values())
        total = sum(total for _, total in self._layers.values())
        if not total:
            return f"pulling {self._image}"
        if done >= total:
            return f"unpacking {self._image}"
        return f"pulling {self._image}: {done / 1e6:.0f} of {total / 1e6:.0f} MB"


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


def ensure_image(engine: Engine, options: DockerOptions, image: str, tell: Callable[[str], None]) -> str:
    """The id of an image that is on the engine, after a pull if need be.

    Args:
        engine: Where.
        options: The site's: when to pull, and with which credentials.
        image: As the manifest names it.
        tell: Called with each step of a pull.

    Raises:
        EngineGoneError: The engine does not answer.
        RuntimeFailure: The image is missing and cannot be pulled.
    """
    if options.pull != "always":
        found = _find(engine, image)
        if found is not None:
            return found
        if options.pull == "never":
            raise RuntimeFailure(f"image '{image}' is not on the engine, and the site's option 'pull' is never")
    _pull(engine, options, image, tell)
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


def _pull(engine: Engine, options: DockerOptions, image: str, tell: Callable[[str], None]) -> None:
    trouble = ""
    progress = Progress(image)
    tell(progress.text({}))
    with engine.asked():
        try:
            api = engine.api(_PULL_SILENCE_S)
            pinned = "@" in image or ":" in image.rpartition("/")[2]
            name = image if pinned else f"{image}:latest"  # or the engine would fetch every tag there is
            for message in api.pull(name, stream=True, decode=True, auth_config=_credentials(options, image)):
                tell(progress.text(message))
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
