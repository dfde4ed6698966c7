"""Machines that are parts of this one: each is a site of its own, over the engine that is here or over processes.

For tests, and for whoever wants to see a group at work before paying for machines. Such a machine is a file in the
orchestrator's state, and an owner under which its site's instances are found: what is destroyed with it.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator
from typing_extensions import override

from skytether.api.manifest import ServiceSpec, Strict
from skytether.api.rest import SiteCreate

from ..domain.errors import InvalidError
from ..domain.validation import parse
from ..runtimes.base import Capacity, RuntimeFailure
from ..scheduling.runtime_entry_points import load_runtime
from ..scheduling.sites import dismantle
from .base import Condition, Found, Order, Provider, ProviderFailure, ProviderSilentError, SiteShape

_OURS = ("cpu", "memory_mb", "owner", "folder")
"""Options of the sites that are not given, but made."""


class LocalOptions(Strict):
    """Options of a group of parts of this machine."""

    runtime: Literal["process", "docker"] = "process"
    """What starts instances there."""
    cpu: Annotated[float, Field(gt=0)] = 1.0
    """Cores of each machine."""
    memory_mb: Annotated[int, Field(gt=0)] = 1024
    options: dict[str, Any] = {}
    """More options of the runtime, the same for all of the group's sites."""

    @model_validator(mode="after")
    def _not_ours(self) -> LocalOptions:
        for key in _OURS:
            if key in self.options:
                raise ValueError(f"options.{key} is made for each machine: leave it out")
        return self


class LocalProvider(Provider):
    """Makes sites of this machine's Docker engine, or of its processes."""

    Options = LocalOptions
    joins = False
    settle_s = 0.0

    @override
    def __init__(self, group: str, owner: str, folder: Path, options: Strict) -> None:
        if not isinstance(options, LocalOptions):
            raise TypeError("options must be LocalOptions")
        self._owner, self._folder, self._options = owner, folder, options
        self._kind = load_runtime(options.runtime)
        try:
            parse(self._kind.Options, self._shape(f"{group}-0").options, prefix=("options",))
        except InvalidError as error:
            raise ProviderFailure(str(error)) from error
        self._notes = folder / "machines"
        self._notes.mkdir(mode=0o700, exist_ok=True)

    def offer(self) -> Capacity:
        return Capacity(self._options.cpu, self._options.memory_mb)

    @override
    def refuses(self, spec: ServiceSpec) -> str | None:
        if self._options.runtime == "docker":
            return super().refuses(spec)
        return None if spec.entrypoint else "the service has no entrypoint, and the machines run processes"

    def make(self, order: Order) -> str:
        with_owner = f"{self._owner} {order.name}"
        try:
            with (self._notes / order.name).open("x") as note:
                note.write(with_owner)
        except FileExistsError:
            pass
        except OSError as error:
            raise ProviderFailure(f"{error.filename}: {error.strerror}") from error
        return order.name

    def machines(self) -> Sequence[Found]:
        # Another group of this name may have had the folder: whose a machine is, stands in its note, if it was written.
        notes = ((note, note.read_text()) for note in self._notes.iterdir())
        ours = [note for note, text in notes if text in ("", f"{self._owner} {note.name}")]
        return [Found(note.name, note.name, Condition.THERE) for note in sorted(ours)]

    def destroy(self, machine: str) -> None:
        shape = self._shape(machine)
        site = SiteCreate(name=machine, tier="edge", runtime=shape.runtime, options=dict(shape.options))
        if not (self._notes / machine).exists():
            return
        try:
            dismantle([site], self._folder, erase=True)  # it may never have been a site, or not have been empty
        except RuntimeFailure as error:
            raise ProviderSilentError(str(error)) from error
        shutil.rmtree(self._folder / machine, ignore_errors=True)  # what its services wrote goes with it
        (self._notes / machine).unlink(missing_ok=True)

    @override
    def site(self, name: str) -> SiteShape:
        return self._shape(name)

    def _shape(self, name: str) -> SiteShape:
        suffix = name.rpartition("-")[2]
        options: Mapping[str, Any] = {
            "cpu": self._options.cpu,
            "memory_mb": self._options.memory_mb,
            "owner": f"{self._owner[:20]}-{suffix}",
        }
        own: dict[str, Any] = (
            {"network": f"skytether-{suffix}"}
            if self._options.runtime == "docker"
            else {"folder": str(self._folder / name)}
        )
        return SiteShape(self._options.runtime, {**own, **self._options.options, **options})
