"""Invitations for machines of groups of sites: each joins by itself, with a token that nobody has to carry there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from skytether.api.groups import GroupCreate
from skytether.api.rest import SiteCreate

from ..domain.errors import DomainError
from ..providers.base import Invitation, ProviderFailure
from .enrolment import RUNTIME, Enrolment


class MachineInvites:
    """Makes the join token of each machine; it ends when the machine should have been a site."""

    def __init__(self, enrolment: Enrolment | None, urls: Sequence[str]) -> None:
        """What it makes them by.

        Args:
            enrolment: None: no machine can join.
            urls: Where machines reach the orchestrators.
        """
        self._enrolment = enrolment
        self._urls = tuple(urls)

    def lacks(self) -> str:
        """What is to be set before machines can join; empty: nothing."""
        if self._enrolment is None:
            return "nodes.port (SKYTETHER_NODES_PORT=8603), where they connect"
        return "" if self._urls else "nodes.urls, the addresses https://HOST:PORT at which they reach the orchestrators"

    def __call__(self, machine: str, group: GroupCreate, options: Mapping[str, Any]) -> Invitation:
        """For one machine, in place of those before.

        Raises:
            ProviderFailure: No machine can join, or not as this.
        """
        if self._enrolment is None or not self._urls:
            raise ProviderFailure(f"no machine can join: set {self.lacks()}")
        site = SiteCreate(
            name=machine,
            tier=group.tier,
            runtime=RUNTIME,
            options=dict(options),
            speed=group.speed,
            cost=group.cost,
            images=group.images,
        )
        try:
            _, token = self._enrolment.invite(site, group.join_timeout_s, f"group:{group.name}", by_owner=True)
        except DomainError as error:
            raise ProviderFailure(str(error)) from error
        return Invitation(self._urls[0], token)
