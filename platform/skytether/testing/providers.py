"""A provider that makes nothing, with the faults of those that do: for tests of what stands above a provider."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Annotated

from pydantic import Field
from typing_extensions import override

from skytether.api.manifest import ServiceSpec, Strict
from skytether.orchestrator.providers.base import (
    Condition,
    Found,
    Order,
    Provider,
    ProviderFailure,
    ProviderSilentError,
    SiteShape,
)
from skytether.orchestrator.runtimes.base import Capacity


class FakeProviderOptions(Strict):
    """Options of the fake."""

    cpu: Annotated[float, Field(gt=0)] = 4.0
    memory_mb: Annotated[int, Field(gt=0)] = 8192


@dataclass
class FakeCloud:
    """The made-up cloud, which outlives the orchestrators that use it."""

    there: dict[str, tuple[str, Found]] = field(default_factory=dict)
    """By id, the owner and the machine."""
    orders: list[Order] = field(default_factory=list)
    """All that was ever made."""
    destroyed: list[str] = field(default_factory=list)
    """Ids, in order."""
    most: int = 1000
    """Machines that anybody may have."""
    silent: bool = False
    """It answers nothing, and does nothing."""
    loses_answers: bool = False
    """It makes what it is asked for, and the answer is lost."""
    lists_late: bool = False
    """What was made is not listed yet."""
    on_call: Callable[[str], None] = lambda _: None
    """Called with what is about to be done, and after it with ``done``: whoever raises there was killed then."""
    ids: count[int] = field(default_factory=lambda: count(1))

    def fail(self, name: str, reason: str) -> None:
        """A machine will never be there."""
        for id_, (owner, found) in self.there.items():
            if found.name == name:
                self.there[id_] = owner, replace(found, condition=Condition.FAILED, reason=reason)

    def names(self) -> list[str]:
        return sorted(found.name for _, found in self.there.values())


class FakeProvider(Provider):
    """Machines are there at once, and each is a site of the fake runtime."""

    Options = FakeProviderOptions
    joins = False
    settle_s = 15.0

    @override
    def __init__(self, group: str, owner: str, folder: Path, options: Strict, cloud: FakeCloud | None = None) -> None:
        """``cloud``: that of an earlier provider, or of another orchestrator."""
        if not isinstance(options, FakeProviderOptions):
            raise TypeError("options must be FakeProviderOptions")
        self.cloud = cloud or FakeCloud()
        self._owner, self._options = owner, options

    def offer(self) -> Capacity:
        self._answer()
        return Capacity(self._options.cpu, self._options.memory_mb)

    @override
    def refuses(self, spec: ServiceSpec) -> str | None:
        return None if spec.entrypoint else "the service has no entrypoint"

    def make(self, order: Order) -> str:
        cloud = self.cloud
        self._answer()
        cloud.on_call("make")
        for found in self._ours():
            if found.name == order.name:
                return found.id
        if len(cloud.there) >= cloud.most:
            raise ProviderFailure(f"the quota of {cloud.most} machines is used up: raise it, or lower the group's max")
        id_ = f"vm-{next(cloud.ids)}"
        cloud.there[id_] = self._owner, Found(id_, order.name, Condition.THERE, made_at=id_)
        cloud.orders.append(order)
        cloud.on_call("make done")
        if cloud.loses_answers:
            raise ProviderSilentError("the cloud did not answer")
        return id_

    def machines(self) -> Sequence[Found]:
        self._answer()
        return [] if self.cloud.lists_late else self._ours()

    def _ours(self) -> list[Found]:
        return [found for owner, found in self.cloud.there.values() if owner == self._owner]

    def destroy(self, machine: str) -> None:
        self._answer()
        self.cloud.on_call("destroy")
        if self.cloud.there.pop(machine, None):
            self.cloud.destroyed.append(machine)
        self.cloud.on_call("destroy done")

    @override
    def site(self, name: str) -> SiteShape:
        return SiteShape("fake", {"cpu": self._options.cpu, "memory_mb": self._options.memory_mb})

    def _answer(self) -> None:
        if self.cloud.silent:
            raise ProviderSilentError("the cloud does not answer")
