"""What the database holds of nodes and of invitations to join."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Engine, Row, delete, insert, select, update
from sqlalchemy.exc import IntegrityError

from skytether.api.node import Machine
from skytether.api.rest import SiteCreate

from ..domain.security import TokenHash
from .models import invitations, nodes, sites


@dataclass(frozen=True, slots=True)
class Invitation:
    """What is kept of a join token."""

    id: str
    hash: TokenHash
    site: SiteCreate
    """As it is to be, but for what the node says of itself."""
    by: str
    """Who made it, as the audit names them."""
    created_at: float
    expires_at: float
    used_at: float | None = None
    used_from: str | None = None
    used_key: str | None = None
    """SHA-256 of the public key that got a certificate."""


@dataclass(frozen=True, slots=True)
class Node:
    """A machine that joined."""

    site: str
    serial: str
    """Of the certificate that it showed last."""
    ends_at: float
    """When that ends."""
    joined_at: float
    seen_at: float
    seen_as: str
    """Address that its connections come from."""
    machine: Machine
    follow: bool = False
    """Whether robots are told the machine's present address."""
    next_serial: str | None = None
    """Of the one that it was given and has not shown yet."""


class NodeRows:
    """Safe from any thread."""

    def __init__(self, writing: Callable[[], AbstractContextManager[Connection]], reader: Engine) -> None:
        """``writing`` gives a transaction."""
        self._writing = writing
        self._reader = reader

    def invite(self, invitation: Invitation, forgotten_before: float) -> None:
        """In the place of one for the same site that was not used; those that ended before a time are forgotten."""
        gone = (invitations.c.name == invitation.site.name) & invitations.c.used_at.is_(None)
        row = {
            "id": invitation.id,
            "prefix": invitation.hash.prefix,
            "sha256": invitation.hash.digest,
            "site": invitation.site.model_dump(mode="json"),
            "name": invitation.site.name,
            "by": invitation.by,
            "created_at": invitation.created_at,
            "expires_at": invitation.expires_at,
        }
        with self._writing() as connection:
            connection.execute(delete(invitations).where(gone | (invitations.c.expires_at < forgotten_before)))
            connection.execute(insert(invitations).values(**row))

    def invitations(self, prefix: str) -> list[Invitation]:
        """Those whose tokens begin so."""
        with self._reader.connect() as connection:
            return [
                _invitation(row)
                for row in connection.execute(select(invitations).where(invitations.c.prefix == prefix))
            ]

    def join(self, invitation: Invitation, site: SiteCreate, node: Node, key: str) -> bool:
        """Spend a token, and have site and node be there, all or nothing.

        Args:
            invitation: As it was read.
            site: As it is to be.
            node: Its machine.
            key: SHA-256 of its public key.

        Returns:
            False if the token was spent meanwhile, or there is such a site.
        """
        unused = (invitations.c.id == invitation.id) & invitations.c.used_at.is_(None)
        spent = {"used_at": node.joined_at, "used_from": node.seen_as, "used_key": key}
        try:
            with self._writing() as connection:
                if not connection.execute(update(invitations).where(unused).values(**spent)).rowcount:
                    return False
                connection.execute(insert(sites).values(**site.model_dump()))
                connection.execute(insert(nodes).values(**_values(node)))
        except IntegrityError:
            return False
        return True

    def all(self) -> dict[str, Node]:
        """By site."""
        with self._reader.connect() as connection:
            return {row.site: _node(row) for row in connection.execute(select(nodes))}

    def get(self, site: str) -> Node | None:
        """None: no machine joined as this site, or it was removed."""
        with self._reader.connect() as connection:
            row = connection.execute(select(nodes).where(nodes.c.site == site)).one_or_none()
        return _node(row) if row else None

    def seen(self, site: str, at: float, seen_as: str, machine: Machine | None = None) -> None:
        """A machine is linked; nothing if it was removed meanwhile."""
        values: dict[str, Any] = {"seen_at": at, "seen_as": seen_as}
        if machine is not None:
            values["machine"] = machine.model_dump(mode="json")
        with self._writing() as connection:
            connection.execute(update(nodes).where(nodes.c.site == site).values(**values))

    def promote(self, site: str, serial: str, ends_at: float) -> None:
        """A certificate was shown for the first time: it takes the place of the one before."""
        first = (nodes.c.site == site) & (nodes.c.next_serial == serial)
        with self._writing() as connection:
            values = {"serial": serial, "ends_at": ends_at, "next_serial": None}
            connection.execute(update(nodes).where(first).values(**values))

    def promise(self, site: str, serial: str, instead_of: str | None) -> bool:
        """Let another certificate be good in the place of one that was not shown yet; False: somebody was quicker."""
        there = (nodes.c.site == site) & (
            nodes.c.next_serial.is_(None) if instead_of is None else nodes.c.next_serial == instead_of
        )
        with self._writing() as connection:
            return bool(connection.execute(update(nodes).where(there).values(next_serial=serial)).rowcount)


def _values(node: Node) -> dict[str, Any]:
    kept = ("site", "serial", "ends_at", "next_serial", "follow", "joined_at", "seen_at", "seen_as")
    return {name: getattr(node, name) for name in kept} | {"machine": node.machine.model_dump(mode="json")}


def _node(row: Row[Any]) -> Node:
    kin = {"follow": row.follow, "next_serial": row.next_serial}
    times = {"ends_at": row.ends_at, "joined_at": row.joined_at, "seen_at": row.seen_at}
    machine = Machine.model_validate(row.machine)
    return Node(site=row.site, serial=row.serial, seen_as=row.seen_as, machine=machine, **times, **kin)


def _invitation(row: Row[Any]) -> Invitation:
    return Invitation(
        id=row.id,
        hash=TokenHash(row.prefix, row.sha256),
        site=SiteCreate.model_validate(row.site),
        by=row.by,
        created_at=row.created_at,
        expires_at=row.expires_at,
        used_at=row.used_at,
        used_from=row.used_from,
        used_key=row.used_key,
    )
