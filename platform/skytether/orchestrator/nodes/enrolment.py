"""Who may join, and who has joined: invitations, certificates, and what becomes of a site with them. No network here.

A token is good once, for a short time, for one name. A certificate is good if the database has its serial: the one that
a node showed last, or the next one, which takes its place when it is shown. So of one node two are good at most, a
copy of an old key is worth nothing, and none is good any more when its site is gone.
"""

from __future__ import annotations

import logging
import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

from cryptography import x509

from skytether.api.node import Address, Issued, Join, Machine
from skytether.api.rest import SiteCreate

from ..domain.errors import ConflictError, NotFoundError, UnauthenticatedError, UnknownTokenError
from ..domain.rate_limit import RateLimiter
from ..domain.security import PREFIX_LENGTH, TokenHash, new_token
from ..scheduling.sites import NODE, Sites
from ..store.database import Database
from ..store.node_rows import Invitation, Node
from .authority import Authority, fingerprint, name_in, pem_of, requested_key, serial_of

log = logging.getLogger(__name__)

RUNTIME = "docker"
"""What starts instances on a joined machine."""
LONGEST_S = 86_400.0
"""Seconds that a token is good for, at most."""
_DAY = 86_400.0
_MOVES_PER_S, _MOVES = 0.1, 5
"""Changes of address of one node, and at once: with each its site is opened anew."""


@dataclass(frozen=True, slots=True)
class Known:
    """A node that showed its certificate."""

    node: Node
    begins_at: float
    ended: bool
    """It is over: it may get another one, and nothing else."""

    @property
    def name(self) -> str:
        return self.node.site


class RemovedError(UnauthenticatedError):
    """The site of a node was removed, and its certificates with it."""


class Enrolment:
    """Joined machines as the database has them. Safe from any thread."""

    def __init__(
        self,
        store: Database,
        sites: Sites,
        authority: Authority,
        clock: Callable[[], float],
        days: float,
        renew_days: float,
        urls: tuple[str, ...] = (),
    ) -> None:
        """What it decides by.

        Args:
            store: The database.
            sites: Where a machine that joins becomes one.
            authority: Signs.
            clock: Seconds since the epoch.
            days: How long a certificate is good for.
            renew_days: For how long after that it may still be renewed.
            urls: Where nodes find the orchestrators.
        """
        self._rows = store.nodes
        self._sites = sites
        self._authority = authority
        self._clock = clock
        self._days = days
        self._renew_s = renew_days * _DAY
        self._moves = RateLimiter(_MOVES_PER_S, _MOVES, time.monotonic)
        self.urls = urls

    # Invitations

    def invite(self, site: SiteCreate, ttl_s: float, by: str, *, by_owner: bool) -> tuple[Invitation, str]:
        """Let one machine join as a site within a time. The token cannot be shown again.

        An invitation for the same name that was not used is worth nothing from then on.

        Raises:
            ConflictError: There is such a site.
            ForbiddenError: Options that only the operator of the state folder may give.
            InvalidError: Wrong options.
        """
        asked = site.model_copy(update={"runtime": RUNTIME, "options": self._options(site, "node.invalid", None)})
        self._sites.check(asked, by_owner=by_owner)
        now, token = self._clock(), new_token()
        kept = site.model_copy(update={"runtime": RUNTIME})
        invitation = Invitation(secrets.token_hex(8), TokenHash.of(token), kept, by, now, now + min(ttl_s, LONGEST_S))
        self._rows.invite(invitation, forgotten_before=now - LONGEST_S)
        return invitation, f"{token}.{self._authority.pin}"

    def check_token(self, token: str) -> Invitation:
        """What a token is good for.

        Raises:
            UnauthenticatedError: Nothing, or nothing any more; the text says which.
            ConflictError: There is a site of its name by now.
        """
        invitation = self._unused(token)
        try:
            self._check_free(invitation)
        except ConflictError:
            self._unused(token)  # the site may be what somebody just made by this token
            raise
        return invitation

    def _unused(self, token: str) -> Invitation:
        invitation = self._find(token)
        if invitation.used_at is not None:
            raise UnauthenticatedError(
                f"this join token was used at {_when(invitation.used_at)} from {invitation.used_from}: each is good "
                f"for one machine; {_another(invitation.site.name)}"
            )
        return invitation

    def _find(self, token: str) -> Invitation:
        given = token.strip().partition(".")[0]
        for invitation in self._rows.invitations(given[:PREFIX_LENGTH]):
            if invitation.hash.matches(given):
                if self._clock() >= invitation.expires_at:
                    raise UnauthenticatedError(
                        f"this join token was good until {_when(invitation.expires_at)}; "
                        f"{_another(invitation.site.name)}"
                    )
                return invitation
        raise UnknownTokenError(
            "this join token is not known here: another one was made for the same name since, or it is another "
            "orchestrator's; make one with `skytether site invite NAME`"
        )

    def _check_free(self, invitation: Invitation) -> None:
        name = invitation.site.name
        if self._sites.find_anew(name) is not None:
            raise ConflictError(
                f"there is a site '{name}' already: invite this machine under another name, or remove that one first "
                f"(`skytether site remove {name}`); the token is still good"
            )

    # Joining

    def join(self, asked: Join, seen_as: str) -> tuple[Node, Issued]:
        """Make a machine a site, and sign its certificate: all of it, or nothing, and the token is as good as before.

        A machine whose answer was lost may ask again with the same token and key, as long as the site is the one that
        it made.

        Raises:
            UnauthenticatedError: The token is not good.
            ConflictError: There is such a site.
            InvalidError: The request, or what it says, is wrong.
        """
        invitation, key = self._find(asked.token), requested_key(asked.request)
        if invitation.used_key == fingerprint(key):
            node = self._rows.get(invitation.site.name)
            if node is not None and node.joined_at == invitation.used_at:
                return node, self._issue(node, asked.request)
        invitation = self.check_token(asked.token)
        name, now = invitation.site.name, self._clock()
        certificate = self._authority.sign(asked.request, name, self._days)
        node = Node(
            site=name,
            serial=serial_of(certificate),
            ends_at=certificate.not_valid_after_utc.timestamp(),
            joined_at=now,
            seen_at=now,
            seen_as=seen_as,
            machine=asked.machine,
            follow=asked.follow,
        )
        options = self._options(invitation.site, asked.address, asked.ports)
        site = invitation.site.model_copy(update={"options": options})

        def put(site: SiteCreate) -> bool:
            return self._rows.join(invitation, site, node, fingerprint(key))

        try:
            self._sites.add(site, put=put)
        except ConflictError:
            self.check_token(asked.token)  # somebody else was quicker with this token, or with this name: it says which
            raise
        log.info("site %s joined from %s, invited by %s", name, seen_as, invitation.by)
        return node, Issued(name=name, certificate=pem_of(certificate), urls=self.urls)

    def _options(self, site: SiteCreate, address: Address, ports: tuple[int, int] | None) -> dict[str, Any]:
        """What whoever invited gave goes before what the machine says."""
        own: dict[str, Any] = {"advertise_host": address} | ({"ports": list(ports)} if ports else {})
        return own | dict(site.options) | {"engine": f"{NODE}{site.name}"}

    # Those who have joined

    def admit(self, certificate: x509.Certificate) -> Known:
        """Who shows a certificate of ours. One that is shown for the first time ends the one before.

        Raises:
            UnauthenticatedError: Nobody, any more; the text says why.
        """
        name, serial, now = name_in(certificate), serial_of(certificate), self._clock()
        node = self._rows.get(name)
        if node is None:
            raise RemovedError(
                f"there is no site '{name}' any more: it was removed, and its certificate with it; to join again run "
                f"`skytether site leave` here, and {_another(name)}"
            )
        if serial not in (node.serial, node.next_serial):
            raise UnauthenticatedError(
                f"another certificate was made for '{name}' and is in use: this machine is a copy, or was restored "
                f"from an old backup; run `skytether site leave --force` here, and {_another(name)}"
            )
        begins, ends = certificate.not_valid_before_utc.timestamp(), certificate.not_valid_after_utc.timestamp()
        if now >= ends + self._renew_s:
            raise UnauthenticatedError(
                f"the certificate of '{name}' ended at {_when(ends)}, and could be renewed until "
                f"{_when(ends + self._renew_s)}: remove the site (`skytether site remove {name} --force`), run "
                f"`skytether site leave --force` here, and {_another(name)}"
            )
        if serial == node.next_serial:
            node = replace(node, serial=serial, ends_at=ends, next_serial=None)
            self._rows.promote(name, serial, ends)
        return Known(node, begins, ended=now >= ends)

    def renew(self, known: Known, request: str) -> Issued:
        """Another certificate for a node.

        Raises:
            ConflictError: It asked twice at once.
            InvalidError: The request is none.
        """
        return self._issue(known.node, request)

    def _issue(self, node: Node, request: str) -> Issued:
        certificate = self._authority.sign(request, node.site, self._days)
        if not self._rows.promise(node.site, serial_of(certificate), node.next_serial):
            raise ConflictError("another certificate was made for this node at the same moment: ask again")
        return Issued(name=node.site, certificate=pem_of(certificate), urls=self.urls)

    def linked(self, known: Known, machine: Machine, address: str | None, seen_as: str) -> None:
        """A node is here, and says how it is now. Robots are told another address if it follows the machine's."""
        self._rows.seen(known.name, self._clock(), seen_as, machine)
        if address is None or not known.node.follow:
            return
        site = self._sites.find_anew(known.name)
        if site is None or site.asked.options.get("advertise_host") == address:
            return
        if not self._moves.wait(known.name):
            before = site.asked.options.get("advertise_host")
            self._sites.change_options(known.name, {"advertise_host": address})
            log.warning("site %s came back under another address: %s, no longer %s", known.name, address, before)

    def still_linked(self, seen_as: Mapping[str, str]) -> set[str]:
        """Note that nodes are linked, each with its address; those of them that are no sites any more."""
        there = self._rows.all().keys()
        for name in seen_as.keys() & there:
            self._rows.seen(name, self._clock(), seen_as[name])
        return seen_as.keys() - there

    def get(self, name: str) -> Node:
        """A node.

        Raises:
            NotFoundError: There is none of that name.
        """
        node = self._rows.get(name)
        if node is None:
            raise NotFoundError(f"no machine has joined as '{name}'")
        return node

    def all(self) -> dict[str, Node]:
        """By site."""
        return self._rows.all()


def _another(name: str) -> str:
    return f"make another token with `skytether site invite {name}`"


def _when(at: float) -> str:
    return datetime.fromtimestamp(at, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
