"""What is known of a ROS 2 graph from its liveliness tokens, and what in it does not fit our table."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from skytether.messages import hash_of

from .dialect import Dialect, Endpoint, Kind

MAX_TOKENS = 100_000
"""Endpoints of others that are remembered; what comes on top is not looked at."""


@dataclass(frozen=True, slots=True)
class Mismatch:
    """An endpoint of the graph that has one of our names, but another type."""

    endpoint: Endpoint
    reason: str
    """One sentence that names the topic and both values."""


class Graph:
    """Endpoints of others, by their tokens. Not safe for several threads.

    Args:
        dialect: How the tokens are written.
        ours: Session id of our own tokens, which are left out.
    """

    def __init__(self, dialect: Dialect, ours: str) -> None:
        self._dialect = dialect
        self._ours = ours
        self._known: dict[str, Endpoint] = {}

    def update(self, token: str, alive: bool) -> Endpoint | None:
        """Take one change of a token. Returns the endpoint that came or went, if this tells anything new."""
        if not alive:
            return self._known.pop(token, None)
        parsed = self._dialect.parse(token)
        if parsed is None or parsed[0] == self._ours or token in self._known or len(self._known) >= MAX_TOKENS:
            return None
        self._known[token] = parsed[1]
        return parsed[1]

    def known(self) -> dict[str, Endpoint]:
        """All of them by their tokens; another life of the same endpoint has another token."""
        return dict(self._known)

    def endpoints(self, name: str | None = None, kind: Kind | None = None) -> list[Endpoint]:
        """Those of a name and a kind, or all of them, in the order of their names."""
        found = (e for e in self._known.values() if name in (None, e.name) and kind in (None, e.kind))
        return sorted(found, key=lambda e: (e.name, e.kind, e.node))


def mismatches(ours: Endpoint, others: Iterable[Endpoint]) -> list[Mismatch]:
    """Endpoints of the other kind and our name whose type or type hash is not ours."""
    found = []
    for other in others:
        if other.kind is not ours.kind.answers or other.name != ours.name:
            continue
        what = ""
        if other.type != ours.type:
            what = f"type {other.type}, this end's is {ours.type}"
        elif other.type_hash and ours.type_hash and other.type_hash != ours.type_hash:
            what = f"{other.type} with type hash {other.type_hash}, this end's is {ours.type_hash}"
        else:
            what = next(_other_parts(other), "")
        if what:
            node = f" of {other.node}" if other.node else ""
            found.append(Mismatch(other, f"{ours.name}: the {_WORDS[other.kind]}{node} has {what}; it is not joined"))
    return found


def _other_parts(other: Endpoint) -> Iterator[str]:
    """Request and response of a service whose hashes are not those of the type that we know."""
    for part, told in zip(("Request", "Response"), other.parts, strict=True):
        known = hash_of(f"{other.type}_{part}", "cdr") if told else ""
        if known and known != told:
            yield f"{other.type}_{part} with type hash {told}, this end's is {known}"


def learned_hash(ours: Endpoint, others: Iterable[Endpoint]) -> str:
    """Type hash of the endpoints on the other side, for a type whose definition is not known here; empty if none."""
    hashes = {
        o.type_hash for o in others if o.kind is ours.kind.answers and o.name == ours.name and o.type == ours.type
    }
    return min(hashes - {""}, default="")


_WORDS = {
    Kind.PUBLISHER: "publisher",
    Kind.SUBSCRIPTION: "subscription",
    Kind.SERVER: "service",
    Kind.CLIENT: "client",
}
