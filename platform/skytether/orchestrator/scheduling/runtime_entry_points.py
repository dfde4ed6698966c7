"""Runtimes by their names, as installed distributions offer them."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import entry_points

from typing_extensions import override

from skytether.api.manifest import ServiceSpec, Strict

from ..domain.errors import Fault, InvalidError
from ..runtimes.base import Capacity, Launch, Observation, Runtime, RuntimeFailure

RUNTIMES = "skytether.runtimes"


def load_runtime(name: str) -> type[Runtime]:
    """Find a runtime by its entry point.

    Raises:
        InvalidError: There is none, or it cannot be imported; the cause is told.
    """
    found = {point.name: point for point in entry_points(group=RUNTIMES)}
    if name not in found:
        there = ", ".join(sorted(found)) or "none"
        raise InvalidError([Fault("runtime", f"there is no runtime '{name}'; installed are: {there}")])
    try:
        loaded = found[name].load()
    except ImportError as error:
        raise InvalidError([Fault("runtime", f"runtime '{name}' cannot be used: {error}")]) from error
    if not (isinstance(loaded, type) and issubclass(loaded, Runtime)):
        raise InvalidError([Fault("runtime", f"entry point '{name}' is no Runtime")])
    return loaded


class Unusable(Runtime):
    """Stands in for a runtime that cannot be made (its extra was removed, say): the site is listed, with the reason."""

    Options = Strict

    def __init__(self, reason: str) -> None:
        self._reason = reason

    @override
    def refuses(self, spec: ServiceSpec) -> str | None:
        return self._reason

    def capacity(self) -> Capacity:
        raise RuntimeFailure(self._reason)

    @override
    def start(self, launch: Launch) -> None:
        raise RuntimeFailure(self._reason)

    def observe(self) -> Mapping[str, Observation]:
        raise RuntimeFailure(self._reason)

    @override
    def stop(self, instance: str, *, force: bool) -> None:
        raise RuntimeFailure(self._reason)

    @override
    def remove(self, instance: str) -> None:
        raise RuntimeFailure(self._reason)

    @override
    def logs(self, instance: str, lines: int) -> str:
        raise RuntimeFailure(self._reason)
