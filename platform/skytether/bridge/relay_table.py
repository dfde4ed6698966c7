"""What a relay forwards, and where to (rule 9): pure, with time as an argument. The sockets are in `relay`.

A relay holds no key and opens no packet. Of a HELLO it reads the session id and looks for the route of that id: where
the service's end (or the next relay) is. All other packets have an id that changes with each handshake. To which
session that belongs, the relay learns from the target, whose WELCOME has it first. Every address on the robot's side
has a *leg*, a port of its own towards that target, as behind a NAT. So the two ends themselves decide who is who: the
service's end answers to the leg from which authentic packets come, and whoever else has seen the id gets nothing.

A leg begins as a newcomer. Newcomers of a route are few and share a budget of their own, so that no flood of
them touches a session that runs. What goes back to one is bounded by what came from it, until it speaks again after
the target answered it; then it is admitted to its session. To a session that runs it is admitted with the target's
first answer: that is a robot on the move, and must not be held up. Targets answer to authentic packets only, and at
most three times as much to a handshake, so who holds no key cannot have an address flooded through a relay; who holds
one is bounded by the session's rate.
"""

from __future__ import annotations

import re
from collections import Counter, OrderedDict, deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

from skytether.wire.codec.packet import HEADER_SIZE, peek_id

from .datagrams import Address

ID_DIGITS = 16
MAX_IDS = 4
"""Ids of packets that a leg's target may have used of late: handshakes overlap."""
AMPLIFICATION = 3
"""Bytes sent to an address for each byte from it, until it is admitted (as in RFC 9000, section 8)."""
NEWCOMER_IDLE = 10.0
"""Seconds of silence after which a newcomer is forgotten."""
SILENT = 3.0
"""Seconds without a word of its target after which a session makes room where there are too many. The end of a bridge
says something every 100 ms; who speaks in a target's name has to find the port again each time."""


@dataclass(frozen=True, slots=True)
class RelayLimits:
    """Bounds of everything that packets can make a relay hold."""

    sessions: int = 1024
    """Sessions at a time. Beyond that the robots of further ones stay newcomers."""
    addresses: int = 8
    """Legs of a session: addresses of its robot, over several interfaces and before and after a move."""
    newcomers: int = 64
    """Legs of a route that are not admitted yet, and how many may begin in a second."""
    rate_bps: float = 100e6
    """Bits per second of UDP payload, of a session in each direction; newcomers of a route together get the same."""
    burst: float = 0.05
    """Seconds of that rate that may come at once."""
    idle: float = 60.0
    """Seconds of silence after which an address of a robot is forgotten; it begins anew when it speaks again."""

    def __post_init__(self) -> None:
        """Refuse what cannot work.

        Raises:
            ValueError: The text names the setting and its range.
        """
        for name in ("sessions", "addresses", "newcomers"):
            if not getattr(self, name) >= 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        for name in ("rate_bps", "burst", "idle"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be above 0, not {getattr(self, name)}")


class Prefix(NamedTuple):
    """Session ids that begin with the same hexadecimal digits; all 16 digits name one session, none every one."""

    digits: int
    value: int

    @classmethod
    def parse(cls, text: str) -> Prefix:
        """Read ``0123456789abcdef`` (one session), ``0123*`` (all that begin so) or ``*`` (all).

        Raises:
            ValueError: It is none of these.
        """
        match = re.fullmatch(r"([0-9a-fA-F]{0,16})(\*?)", text)
        if match is None or bool(match[2]) == (len(match[1]) == ID_DIGITS):
            raise ValueError(f"'{text}' must be a session's 16 hexadecimal digits, or its first ones and a '*'")
        return cls(len(match[1]), int(match[1] or "0", 16))

    def holds(self, session_id: int) -> bool:
        """Whether an id begins so."""
        return session_id >> 4 * (ID_DIGITS - self.digits) == self.value


class Bucket:
    """Tokens of bytes; open while there are any, so that a batch passes whole."""

    __slots__ = ("_capacity", "_rate", "_tokens", "_updated")

    def __init__(self, rate: float, capacity: float, now: float) -> None:
        self._rate = rate
        self._capacity = self._tokens = capacity
        self._updated = now

    def consume(self, amount: float, now: float) -> bool:
        """Take ``amount``, if there is anything left."""
        if now > self._updated:
            self._tokens = min(self._capacity, self._tokens + (now - self._updated) * self._rate)
            self._updated = now
        if self._tokens <= 0:
            return False
        self._tokens -= amount
        return True


class Flow:
    """Both directions of a session, or of a route's newcomers: budgets and counters."""

    __slots__ = ("bytes_down", "bytes_up", "down", "dropped", "packets_down", "packets_up", "up")

    def __init__(self, limits: RelayLimits, now: float) -> None:
        rate = limits.rate_bps / 8
        self.up, self.down = (Bucket(rate, rate * limits.burst, now) for _ in range(2))
        self.packets_up = self.packets_down = self.bytes_up = self.bytes_down = 0
        self.dropped = 0
        """Packets above the rate."""


class Route:
    """Where packets of some sessions go."""

    __slots__ = ("flow", "newcomers", "openings", "prefix", "target")

    def __init__(self, prefix: Prefix, target: Address, limits: RelayLimits, now: float) -> None:
        self.prefix = prefix
        self.target = target
        self.newcomers: dict[tuple[int, Address], Leg] = {}
        """Oldest first."""
        self.flow = Flow(limits, now)
        """Of the newcomers together."""
        self.openings = Bucket(limits.newcomers, limits.newcomers, now)


class SessionFlow(Flow):
    """A session whose robot was answered."""

    __slots__ = ("answered_at", "legs", "moves")

    def __init__(self, limits: RelayLimits, now: float) -> None:
        super().__init__(limits, now)
        self.answered_at = now
        self.legs: dict[Address, Leg] = {}
        self.moves = Bucket(limits.addresses, limits.addresses, now)
        """Addresses from which its packets may begin to come in a second, whatever strangers do meanwhile."""


class Leg:
    """One address of a robot, and the port towards the target that stands for it there."""

    __slots__ = (
        "answered_at",
        "bytes_down",
        "bytes_up",
        "heard_at",
        "ids",
        "port",
        "route",
        "session",
        "session_id",
        "source",
        "spoken",
    )

    def __init__(self, session_id: int, source: Address, route: Route) -> None:
        self.session_id = session_id
        self.source = source
        """The robot's address."""
        self.route = route
        self.session: SessionFlow | None = None
        """None: a newcomer."""
        self.bytes_up = self.bytes_down = 0
        self.heard_at = 0.0
        self.answered_at: float | None = None
        self.ids: deque[int] = deque()
        """That the target's packets had, newest last."""
        self.spoken: int | None = None
        """The one of them that the robot's newest packet had."""
        self.port: Any = None
        """Whatever its owner keeps with it; nothing here looks at it."""


class RelayTable:
    """Routes, and the legs that packets opened.

    Attributes:
        closed: Legs that ended; the owner takes them and closes their ports.
        rejected: Packets not forwarded, by bounded reason.
    """

    def __init__(self, limits: RelayLimits) -> None:
        self._limits = limits
        self._routes: dict[Prefix, Route] = {}
        self._lengths: list[int] = []
        """Digits of the prefixes, longest first; those of routes that were removed, too: each costs one look."""
        self._legs: dict[tuple[int, Address], Leg] = {}
        self._ids: dict[int, list[Leg]] = {}
        """Legs of a session by an id that its packets have."""
        self.sessions: OrderedDict[int, SessionFlow] = OrderedDict()
        """Those first whose target has been silent for longest."""
        self.closed: deque[Leg] = deque()
        self.rejected: Counter[str] = Counter()

    @property
    def legs(self) -> list[Leg]:
        """All legs, newcomers included."""
        return list(self._legs.values())

    @property
    def routes(self) -> list[Route]:
        """All routes."""
        return list(self._routes.values())

    def add(self, prefix: Prefix, target: Address, now: float) -> None:
        """Route these sessions there, instead of where they were routed before; the longest prefix counts."""
        known = self._routes.get(prefix)
        if known is not None:
            known.target = target
        else:
            before = self._find(prefix.value)
            self._routes[prefix] = Route(prefix, target, self._limits, now)
            if prefix.digits not in self._lengths:
                self._lengths = sorted([*self._lengths, prefix.digits], reverse=True)
            self._rerouted(prefix, before)

    def remove(self, prefix: Prefix) -> bool:
        """Forward these sessions no longer; False if there is no such route."""
        before = self._routes.pop(prefix, None)
        if before is None:
            return False
        self._rerouted(prefix, before)
        return True

    def up(self, data: memoryview | bytes, source: Address, now: float, packets: int = 1) -> Leg | None:
        """A packet, or several of one session, came to the public port.

        Returns:
            The leg through which to send it to ``leg.route.target``; None (counted): to be dropped.
        """
        peeked = peek_id(data)
        if peeked is None:
            self.rejected["short"] += packets
            return None
        hello, packet_id = peeked
        session_id = packet_id
        if not hello:
            known = self._ids.get(packet_id)
            if known is None:
                self.rejected["unknown"] += packets
                return None
            session_id = known[0].session_id
        leg = self._legs.get((session_id, source))
        route = leg.route if leg is not None else self._find(session_id)
        if route is None:
            self.rejected["unknown"] += packets
            return None
        flow: Flow | None = route.flow if leg is None or leg.session is None else leg.session
        if leg is None:
            flow = self._may_open(route, None if hello else session_id, now)
        if flow is None:
            self.rejected["newcomers"] += packets
            return None
        if not flow.up.consume(len(data), now):
            flow.dropped += packets
            self.rejected["rate"] += packets
            return None
        if leg is None:
            leg = self._open(session_id, source, route)
        elif not hello and packet_id in leg.ids:
            leg.spoken = packet_id
        leg.heard_at = now
        leg.bytes_up += len(data)
        flow.packets_up += packets
        flow.bytes_up += len(data)
        if leg.session is None and leg.answered_at is not None:
            self._admit(leg, now)
        return leg

    def down(self, leg: Leg, data: memoryview | bytes, source: Address, now: float, packets: int = 1) -> bool:
        """The same for what came to a leg's port: whether to send it to ``leg.source``."""
        if source != leg.route.target:
            self.rejected["stranger"] += packets
            return False
        peeked = peek_id(data)
        if peeked is None or peeked[0] or not self._learn(leg, peeked[1]):
            self.rejected["session"] += packets
            return False
        leg.answered_at = now
        if leg.session is None and leg.session_id in self.sessions:
            self._admit(leg, now)
        if leg.session is not None:
            leg.session.answered_at = now
            self.sessions.move_to_end(leg.session_id)
        flow: Flow = leg.route.flow if leg.session is None else leg.session
        if flow is leg.route.flow and leg.bytes_down + len(data) > AMPLIFICATION * leg.bytes_up:
            self.rejected["amplification"] += packets
            return False
        if not flow.down.consume(len(data), now):
            flow.dropped += packets
            self.rejected["rate"] += packets
            return False
        leg.bytes_down += len(data)
        flow.packets_down += packets
        flow.bytes_down += len(data)
        return True

    def expire(self, now: float) -> None:
        """Forget addresses that were silent for too long; to be called about once a second."""
        idle = self._limits.idle
        for leg in list(self._legs.values()):
            if leg.heard_at + (idle if leg.session is not None else min(idle, NEWCOMER_IDLE)) <= now:
                self.close(leg)

    def close(self, leg: Leg) -> None:
        """Forget an address."""
        key = leg.session_id, leg.source
        if self._legs.pop(key, None) is None:
            return
        while leg.ids:
            self._unlearn(leg)
        if leg.session is None:
            del leg.route.newcomers[key]
        else:
            del leg.session.legs[leg.source]
            if not leg.session.legs:
                del self.sessions[leg.session_id]
        self.closed.append(leg)

    def _learn(self, leg: Leg, packet_id: int) -> bool:
        """Take note of an id that a leg's target uses; False if it is that of another session."""
        if packet_id in leg.ids:
            return True
        legs = self._ids.setdefault(packet_id, [])
        if legs and legs[0].session_id != leg.session_id:
            return False
        legs.append(leg)
        leg.ids.append(packet_id)
        if len(leg.ids) > MAX_IDS:
            self._unlearn(leg)
        return True

    def _unlearn(self, leg: Leg) -> None:
        """Forget the oldest id of a leg, but that in use: whoever sends as if from the target makes up any number."""
        packet_id = next((one for one in leg.ids if one != leg.spoken), leg.ids[0])
        leg.ids.remove(packet_id)
        legs = self._ids[packet_id]
        legs.remove(leg)
        if not legs:
            del self._ids[packet_id]

    def _find(self, session_id: int) -> Route | None:
        for digits in self._lengths:
            route = self._routes.get(Prefix(digits, session_id >> 4 * (ID_DIGITS - digits)))
            if route is not None:
                return route
        return None

    def _rerouted(self, prefix: Prefix, before: Route | None) -> None:
        """Forget legs whose route is another by now; ``before``: the one that a whole id had.

        Routes of whole ids come and go by the thousand where instances do, so only the legs of that id are looked at.
        """
        if prefix.digits < ID_DIGITS:
            legs = list(self._legs.values())
        else:
            session = self.sessions.get(prefix.value)
            legs = [*session.legs.values()] if session is not None else []
            newcomers = before.newcomers.values() if before is not None else ()
            legs += [leg for leg in newcomers if leg.session_id == prefix.value]
        for leg in legs:
            if self._find(leg.session_id) is not leg.route:
                self.close(leg)

    def _may_open(self, route: Route, known: int | None, now: float) -> Flow | None:
        """What pays for the first packet of a new address; None: it may have no leg.

        ``known``: the session that its packet is of, by the target's word. Only who saw a packet of that session can
        have sent it: no flood of made-up HELLOs holds up a robot that moves.
        """
        session = None if known is None else self.sessions.get(known)
        if session is not None and session.moves.consume(1, now):
            return session
        return route.flow if route.openings.consume(1, now) else None

    def _open(self, session_id: int, source: Address, route: Route) -> Leg:
        if len(route.newcomers) >= self._limits.newcomers:
            self.close(next(iter(route.newcomers.values())))
        leg = Leg(session_id, source, route)
        self._legs[session_id, source] = route.newcomers[session_id, source] = leg
        return leg

    def _admit(self, leg: Leg, now: float) -> None:
        session = self.sessions.get(leg.session_id)
        if session is None:
            if len(self.sessions) >= self._limits.sessions and not self._make_room(now):
                self.rejected["sessions_full"] += 1
                return
            session = self.sessions[leg.session_id] = SessionFlow(self._limits, now)
        del leg.route.newcomers[leg.session_id, leg.source]
        leg.session = session
        session.legs[leg.source] = leg
        if len(session.legs) > self._limits.addresses:
            # The target speaks to where the robot is, so the one that it left long ago is no loss.
            self.close(min(session.legs.values(), key=lambda one: one.answered_at or 0.0))

    def _make_room(self, now: float) -> bool:
        """Forget the session whose target has been silent for longest, if that is long."""
        silent = next(iter(self.sessions.values()))
        if silent.answered_at + SILENT > now:
            return False
        for leg in list(silent.legs.values()):
            self.close(leg)
        return True


def same_session(data: memoryview, segment: int | None) -> Iterator[tuple[memoryview, int | None, int]]:
    """Split a batch into what can be forwarded whole.

    Args:
        data: One datagram, or several of ``segment`` bytes (the last may be shorter) from one address.
        segment: Size of each; None for one.

    Yields:
        Data of one session, size of its datagrams (None for one), and how many they are.
    """
    if segment is None or segment >= len(data):
        yield data, None, 1
        return
    ids = [bytes(data[at : at + 9]) for at in range(0, len(data), segment)]
    if ids.count(ids[0]) == len(ids) and (len(data) % segment or segment) >= HEADER_SIZE:
        yield data, segment, len(ids)
        return
    for at in range(0, len(data), segment):
        yield data[at : at + segment], None, 1
