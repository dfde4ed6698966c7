"""The contract of a provider: it makes machines, lists its own, and destroys them. ``tests/contracts`` checks it.

Whoever calls it may be killed at any moment, and answers get lost. So nothing is kept in memory: what was made for a
group is found again by the group's owner, a word that is noted at each machine, and each machine by its name. A
provider decides nothing; it is called from one thread at a time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, ClassVar

from skytether.api.manifest import ServiceSpec, Strict

from ..runtimes.base import Capacity


class ProviderFailure(Exception):  # noqa: N818 (not an error of ours)
    """The provider refuses; nothing was done. One sentence saying what to do."""


class ProviderSilentError(ProviderFailure):
    """It does not answer, or answered with an error of its own: what was asked for may have been done all the same."""


class Condition(Enum):
    """How a machine is, as its provider knows it."""

    COMING = "coming"
    THERE = "there"
    FAILED = "failed"
    """It will never be there: it is destroyed."""
    GOING = "going"
    """It is being destroyed."""


@dataclass(frozen=True, slots=True)
class Found:
    """One machine of a group."""

    id: str
    """The provider's."""
    name: str
    """As it was ordered."""
    condition: Condition
    reason: str = ""
    """Why it failed, in a sentence."""
    made_at: str = ""
    """In a form that sorts: of two of one name the first is kept."""


@dataclass(frozen=True, slots=True)
class Invitation:
    """With what a machine becomes a site."""

    url: str
    """Where it finds the orchestrator."""
    token: str = field(repr=False)
    """For this machine, good for one use."""


@dataclass(frozen=True, slots=True)
class Order:
    """A machine to be made."""

    name: str
    """Unlike that of any other, and the name of its site."""
    labels: Mapping[str, str] = field(default_factory=dict)
    """To be noted at it, for people."""
    invitation: Invitation | None = None
    """None: it is no machine that joins."""


@dataclass(frozen=True, slots=True)
class SiteShape:
    """How a machine that does not join by itself is reached as a site."""

    runtime: str
    options: Mapping[str, Any]


class Provider(ABC):
    """Of one group."""

    Options: ClassVar[type[Strict]]
    """The group's ``options``, validated; unknown keys are refused by name before the provider is made."""

    joins: ClassVar[bool] = True
    """Its machines become sites by themselves, by an invitation; otherwise ``site`` says how they are reached."""

    settle_s: ClassVar[float] = 15.0
    """Seconds after an order without an answer by which ``machines`` lists what was made all the same."""

    @abstractmethod
    def __init__(self, group: str, owner: str, folder: Path, options: Strict) -> None:
        """Take charge of what is there already; asks nobody.

        Args:
            group: The group's name.
            owner: The word by which its machines are found again: lower-case letters and digits, 12 to 32.
            folder: The provider's own, kept over restarts; it exists, with mode 0700.
            options: Of type ``Options``.

        Raises:
            ProviderFailure: It can never work with these options.
        """

    @abstractmethod
    def offer(self) -> Capacity:
        """What instances can have of one machine. Called every few seconds, so it should be cheap.

        Raises:
            ProviderSilentError: It does not answer.
            ProviderFailure: With these options none can be made: something that they name is not there.
        """

    def refuses(self, spec: ServiceSpec) -> str | None:
        """Why its machines cannot run a service at all; None: they can. Pure."""
        return None if spec.image else "the service has no image, and the machines run containers"

    @abstractmethod
    def make(self, order: Order) -> str:
        """Have a machine made, and return at once; gives its id. One of that name that is there already is it.

        Raises:
            ProviderSilentError: No answer; ``machines`` tells by and by whether it was made.
            ProviderFailure: Refused, with the reason (a quota, say); nothing was made.
        """

    @abstractmethod
    def machines(self) -> Sequence[Found]:
        """All of this group and of no other, until they are destroyed.

        Raises:
            ProviderFailure: It does not answer, or refuses; part of them is no answer.
        """

    @abstractmethod
    def destroy(self, machine: str) -> None:
        """Have a machine destroyed, with what was made for it, and return at once. One that is not there is no error.

        Args:
            machine: Its id.

        Raises:
            ProviderFailure: It does not answer, or refuses.
        """

    def site(self, name: str) -> SiteShape | None:  # noqa: ARG002 (most machines join)
        """How a machine is reached as a site; None: it becomes one by itself. Pure."""
        return None

    @property
    def site_options(self) -> Mapping[str, Any]:
        """What the runtime of machines that join is told."""
        return {}

    def close(self) -> None:  # noqa: B027 (most need none)
        """Let go; the machines stay."""
