"""Where a path's peer seems to be, until it has shown that it is there (RFC 9000, sections 8.2 and 9.3).

An authentic message from another address may come from a peer that moved, or from somebody who repeats what he
overheard, faster than the network carries it. So it is a candidate, no more: the address in use stays in use, and a
challenge goes to the other one: random bits, which no peer can repeat that did not get them, not even one that has the
key and names somebody else's address. Only an answer to it moves the session. Until then the candidate is sent
copies of what goes to the one in use, so that a peer that did move misses little; with the challenges they are at most
`AMPLIFICATION_LIMIT` times the bytes that came from there, so that nobody is flooded by a session he has no part in.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Hashable, Iterator

AMPLIFICATION_LIMIT = 3
"""Bytes that an address may be sent for each that came from it before it has answered."""
MAX_CANDIDATES = 4
"""Addresses of one path that are tested at the same time; the oldest candidate gives way."""
SPACING = 0.05
"""Seconds between challenges to one address."""
MAX_CHALLENGES = 64
"""Challenges to one address of which an answer counts."""


class Candidate:
    """One address that authentic messages came from."""

    __slots__ = ("asked_at", "challenges", "left", "since")

    def __init__(self, since: float) -> None:
        self.since = since
        """When the peer was last heard from the address in use."""
        self.left = 0
        """Bytes that may still be sent there."""
        self.asked_at = float("-inf")
        self.challenges: deque[int] = deque(maxlen=MAX_CHALLENGES)


class PathValidation:
    """The candidates of one path."""

    __slots__ = ("_open",)

    def __init__(self) -> None:
        self._open: OrderedDict[Hashable, Candidate] = OrderedDict()

    def __len__(self) -> int:
        return len(self._open)

    def packet_came(self, address: Hashable, size: int, since: float, now: float) -> bool:
        """An authentic message, newer than all before, came from an address that is not the one in use.

        Args:
            address: From where.
            size: Bytes of it.
            since: When the peer was last heard from the address in use.
            now: Time.

        Returns:
            Whether to challenge it now.
        """
        candidate = self._open.get(address)
        if candidate is None:
            if len(self._open) >= MAX_CANDIDATES:
                self._open.popitem(last=False)
            candidate = self._open[address] = Candidate(since)
        candidate.left += AMPLIFICATION_LIMIT * size
        return now >= candidate.asked_at + SPACING

    def challenge(self, address: Hashable, challenge: int, now: float) -> None:
        """These random bits are sent to an address now."""
        candidate = self._open[address]
        candidate.asked_at = now
        candidate.challenges.append(challenge)

    def sent(self, address: Hashable, size: int) -> None:
        """So many bytes went to an address."""
        candidate = self._open.get(address)
        if candidate is not None:
            candidate.left -= size

    def answered(self, challenge: int) -> tuple[Hashable, float] | None:
        """The peer answers with these bits.

        Returns:
            The address that it was sent to, and ``since`` of the candidate; None if it was no challenge. All are
            settled then.
        """
        for address, candidate in self._open.items():
            if challenge in candidate.challenges:
                self._open.clear()
                return address, candidate.since
        return None

    def clear(self) -> None:
        """Forget them."""
        self._open.clear()

    def allowances(self, total: int, segment: int | None) -> Iterator[tuple[Hashable, int]]:
        """Who is to have a copy of a batch.

        Args:
            total: Its bytes.
            segment: Bytes of one datagram, if it is several.

        Yields:
            Address, and how many bytes of it may go there: whole datagrams.
        """
        for address, candidate in self._open.items():
            size = total if total <= candidate.left else candidate.left // segment * segment if segment else 0
            if size > 0:
                candidate.left -= size
                yield address, size
