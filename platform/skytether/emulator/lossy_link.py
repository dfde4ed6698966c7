"""Two ends of a session over a made-up link in made-up time: no socket, no waiting, the same every time.

    link = LossyLink(robot, service, up=LinkConditions(delay=0.05, loss=0.05), down=LinkConditions(delay=0.05))
    link.run(1.0)
    robot.publish("scan", b"...", link.now)
    link.run(0.2)
    assert link.messages[Role.SERVICE]

What happens to each packet is decided by the same model as in `udp_link`, which does it to real sockets.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Callable
from itertools import count, groupby
from random import Random
from typing import NamedTuple

from skytether.emulator.link_model import LinkConditions, LinkModel
from skytether.wire import Event, MessageReceived, Role, Session, Transmit

_STEPS = 200_000
"""Steps in one run beyond which the two ends are taken to be in an endless exchange."""


class _Arrival(NamedTuple):
    """A packet under way; ordered by time."""

    time: float
    order: int
    receiver: Role
    path: int
    source: str
    packet: bytes


class Road:
    """The network of one path.

    Attributes:
        address: Where the robot's packets come from; set it to make the robot move.
        models: What happens to what each end sends; set ``conditions`` at any time.
        mtu: Largest datagram that passes.
    """

    def __init__(self, address: str, up: LinkConditions | None, down: LinkConditions | None, mtu: int) -> None:
        """Join nothing yet."""
        self.address = address
        self.models = {
            Role.ROBOT: LinkModel(up or LinkConditions(), "up"),
            Role.SERVICE: LinkModel(down or LinkConditions(), "down"),
        }
        self.mtu = mtu

    def set(self, conditions: LinkConditions) -> None:
        """Change both directions."""
        for model in self.models.values():
            model.conditions = conditions


class LossyLink:
    """Carries packets between two sessions, and drives both.

    Attributes:
        now: Seconds since any time; the robot's clock.
        sessions: The two ends.
        addresses: Where each end's packets come from; set it to make an end move.
        models: What happens to what each end sends; set ``conditions`` at any time.
        roads: The network by path. `addresses`, `models` and ``mtu`` are those of path 0.
        events: What each end told, without messages: (time, event).
        messages: What each end received, payloads copied: (time, message).
        sent: Packets that each end sent, if ``record`` is set: (time, bytes).
        corrupt: Share of packets in which a bit is flipped or the end is cut off; set it at any time.
        dropped: Packets larger than ``mtu``.
    """

    def __init__(
        self,
        robot: Session,
        service: Session,
        *,
        up: LinkConditions | None = None,
        down: LinkConditions | None = None,
        corrupt: float = 0.0,
        mtu: int = 1472,
        seed: int = 0,
        start: float = 0.0,
        service_clock: tuple[float, float] = (0.0, 0.0),
        record: bool = False,
    ) -> None:
        """Join two sessions; the robot's end is told where the service's is.

        Args:
            robot: The robot's end, made at time ``start``.
            service: The service's end, made at ``service_time(start)``.
            up: From the robot; perfect unless given.
            down: From the service; perfect unless given.
            corrupt: At the beginning.
            mtu: Largest datagram that passes.
            seed: Of corruption and of how packets are batched. The conditions have their own.
            start: Robot's clock at the beginning.
            service_clock: What the service's clock shows more than the robot's at 0, and seconds per second that it
                goes faster.
            record: Keep all packets in ``sent``.
        """
        self.now = start
        self.sessions = {Role.ROBOT: robot, Role.SERVICE: service}
        self.addresses = {Role.ROBOT: "robot", Role.SERVICE: "service"}
        self.roads = {0: Road("robot", up, down, mtu)}
        self.models = self.roads[0].models
        self.events: dict[Role, list[tuple[float, Event]]] = {role: [] for role in Role}
        self.messages: dict[Role, list[tuple[float, MessageReceived]]] = {role: [] for role in Role}
        self.sent: dict[Role, list[tuple[float, bytes]]] = {role: [] for role in Role}
        self.dropped: Counter[Role] = Counter()
        self.corrupt = corrupt
        self._random = Random(seed)
        self._offset, self._drift = service_clock
        self._record = record
        self._order = count()
        self._arrivals: list[_Arrival] = []
        self._plan: list[tuple[float, int, Callable[[], None]]] = []
        robot.set_peer(self.addresses[Role.SERVICE])

    def add_path(
        self,
        path: int,
        *,
        up: LinkConditions | None = None,
        down: LinkConditions | None = None,
        mtu: int = 1472,
        cost: int = 0,
    ) -> Road:
        """Give the robot another network."""
        road = self.roads[path] = Road(f"robot-{path}", up, down, mtu)
        self.sessions[Role.ROBOT].open_path(path, self.now, cost=cost)
        self._drain(Role.ROBOT)
        return road

    def close_path(self, path: int) -> None:
        """Take a network away, as when its interface vanishes."""
        del self.roads[path]
        self.sessions[Role.ROBOT].close_path(path, self.now)
        self._drain(Role.ROBOT)

    def service_time(self, now: float) -> float:
        """The service's clock."""
        return self._offset + now * (1 + self._drift)

    def time_of(self, role: Role) -> float:
        """What an end's clock shows."""
        return self.now if role is Role.ROBOT else self.service_time(self.now)

    def publish(self, role: Role, topic: str, payload: bytes) -> bool:
        """Publish at one end, now."""
        published = self.sessions[role].publish(topic, payload, self.time_of(role))
        self._drain(role)
        return published

    def at(self, when: float, action: Callable[[], object]) -> None:
        """Do something when its time comes."""
        heapq.heappush(self._plan, (when, next(self._order), lambda: (action(), None)[1]))

    def every(self, period: float, until: float, action: Callable[[], object]) -> None:
        """Do something again and again, from one period after now."""
        for i in range(1, int((until - self.now) / period) + 1):
            self.at(self.now + i * period, action)

    def replace(self, role: Role, session: Session) -> None:
        """Put another session in the place of one end, as after a restart."""
        self.sessions[role] = session
        if role is Role.ROBOT:
            session.set_peer(self.addresses[Role.SERVICE])

    def inject(self, role: Role, packet: bytes, address: str = "stranger", segment: int | None = None) -> None:
        """Let an end receive bytes now."""
        self.sessions[role].receive(packet, address, self.time_of(role), segment=segment)
        self._drain(role)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        self.run_until(self.now + seconds)

    def run_until(self, end: float) -> None:
        """Let time pass until ``end``; what is due then is done."""
        for role in Role:
            self._drain(role)
        for _ in range(_STEPS):
            due = self._next()
            if due > end:
                self.now = max(self.now, end)
                return
            self.now = max(self.now, due)
            while self._plan and self._plan[0][0] <= self.now:
                heapq.heappop(self._plan)[2]()
            for role in Role:
                self._deliver(role)
                self.sessions[role].handle_timer(self.time_of(role))
                self._drain(role)
        raise RuntimeError(f"the two ends never come to rest at {self.now} s")

    def _next(self) -> float:
        times = [self._arrivals[0].time if self._arrivals else math.inf, self._plan[0][0] if self._plan else math.inf]
        robot_due = self.sessions[Role.ROBOT].next_timer()
        service_due = self.sessions[Role.SERVICE].next_timer()
        if robot_due is not None:
            times.append(robot_due)
        if service_due is not None:
            # A little later, or rounding could make it a time at which the service's clock does not show it yet.
            times.append((service_due - self._offset) / (1 + self._drift) + 1e-9)
        return min(times)

    def _drain(self, role: Role) -> None:
        session = self.sessions[role]
        while (event := session.next_event()) is not None:
            if isinstance(event, MessageReceived):
                self.messages[role].append((self.now, event))
            else:
                self.events[role].append((self.now, event))
        while batches := session.transmit(self.time_of(role)):
            for batch in batches:
                self._send(role, batch)

    def _send(self, role: Role, batch: Transmit) -> None:
        if 0 in self.roads:
            self.roads[0].address = self.addresses[Role.ROBOT]
        if role is Role.ROBOT:
            receiver, path = Role.SERVICE, batch.path if batch.address == self.addresses[Role.SERVICE] else None
        else:
            receiver = Role.ROBOT
            path = next((i for i, road in self.roads.items() if road.address == batch.address), None)
        road = None if path is None else self.roads.get(path)
        data = bytes(batch.data)
        size = batch.segment or len(data)
        for start in range(0, len(data), size):
            packet = data[start : start + size]
            if self._record:
                self.sent[role].append((self.now, packet))
            if road is None or path is None:
                continue
            if len(packet) > road.mtu:
                self.dropped[role] += 1
                continue
            source = road.address if role is Role.ROBOT else self.addresses[role]
            for arrival in road.models[role].decide(len(packet), self.now):
                entry = _Arrival(arrival, next(self._order), receiver, path, source, self._damage(packet))
                heapq.heappush(self._arrivals, entry)

    def _damage(self, packet: bytes) -> bytes:
        if not self.corrupt or self._random.random() >= self.corrupt:
            return packet
        if self._random.random() < 0.3:
            return packet[: self._random.randrange(len(packet))]
        damaged = bytearray(packet)
        damaged[self._random.randrange(len(packet))] ^= 1 << self._random.randrange(8)
        return bytes(damaged)

    def _deliver(self, role: Role) -> None:
        """Hand over what has arrived, some of it in batches, as a kernel would."""
        arrived: list[_Arrival] = []
        others: list[_Arrival] = []
        while self._arrivals and self._arrivals[0].time <= self.now:
            entry = heapq.heappop(self._arrivals)
            (arrived if entry.receiver is role else others).append(entry)
        for entry in others:
            heapq.heappush(self._arrivals, entry)
        session, now = self.sessions[role], self.time_of(role)
        for (path, source, _), group in groupby(arrived, key=lambda e: (e.path, e.source, len(e.packet))):
            packets = [entry.packet for entry in group]
            while packets:
                taken = min(len(packets), self._random.choice((1, 4, 16, 64)))
                segment = len(packets[0]) if taken > 1 else None
                known = path if role is Role.ROBOT else None
                session.receive(b"".join(packets[:taken]), source, now, segment=segment, path=known)
                del packets[:taken]
        if arrived:
            self._drain(role)
