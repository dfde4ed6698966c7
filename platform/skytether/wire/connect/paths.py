"""Several paths of one session (rule 8): which one is used, when both are, and what keeps them warm.

Each end decides for what it sends. One path is active; the others are asked by pings whether they are there. Traffic
goes over two paths as soon as an answer on the active one is overdue, and for a while whenever another becomes the
active one: make before break. Duplicates end at the receiver's replay window.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator
from typing import NamedTuple

from ..codec.crypto import TAG_SIZE
from ..codec.frames import PING_SIZE, Frame, Ping, push_ping
from ..codec.packet import HEADER_SIZE
from ..codec.plaintext import INNER
from ..config import Config
from ..events import Event, PathSwitched, PeerMoved
from ..path.liveness import HURRY, Health
from ..path.mtu import SMALL
from ..path.path import Path
from ..send.sender import Sender
from ..stats import PathStats
from .reconnect import patience

MAX_PATHS = 8
"""Paths that an end keeps."""
FORGET_AFTER = 10.0
"""Seconds without a message after which the service's end forgets a path, if others are there."""
PING_SPACING = 0.02
"""Least time between pings sent as answers to anything but a ping."""
CHALLENGE_SIZE = 8
LOSS_WEIGHT = 1.0
"""Seconds of delay that losing every packet is as bad as."""
BETTER = 0.7, 0.01
"""A path is better than the active one if it is as bad as this share of it, less these seconds."""
PADDING = HEADER_SIZE + INNER.size + PING_SIZE + TAG_SIZE
"""Bytes of a packet with a ping without padding."""


class Exchange(NamedTuple):
    """Time stamps of a question and its answer: sent and received here by our clock, there by the peer's."""

    sent: float
    peer_received: float
    peer_sent: float


class PathChoice(NamedTuple):
    """Where to send."""

    active: Path
    other: Path | None
    """The best of the rest: for topics that ask for two paths, and for copies."""
    doubled: bool
    """Everything goes over both."""


class Paths:
    """The paths of one end, at least one.

    Args:
        config: Settings.
        first: The path that is there from the beginning.
        sender: Sends pings at once, goes by the choice whenever it is another one, and sends again what went where the
            peer is not any more.
        events: Where it goes that the peer moved, and that another path became the active one.
        entropy: Source of random bytes.
        now: Time.
    """

    def __init__(
        self,
        config: Config,
        first: Path,
        sender: Sender,
        events: deque[Event],
        entropy: Callable[[int], bytes],
        now: float,
    ) -> None:
        self._config = config
        self._sender = sender
        self._events = events
        self._entropy = entropy
        self._paths: dict[int, Path] = {first.id: first}
        self.get: Callable[[int], Path | None] = self._paths.get
        """The path of an id; asked twice for every packet."""
        self._numbers: dict[int, int] = {}
        """Next packet numbers of paths that are closed: none is used twice with the same keys."""
        self.choice = PathChoice(first, None, False)
        self._overlap_until = -math.inf
        self._previous: Path | None = None
        """The active path before, while the overlap lasts."""
        self._better_since: tuple[Path, float] | None = None
        self._chosen_at = now
        self._up = False

    def __iter__(self) -> Iterator[Path]:
        return iter(self._paths.values())

    def __len__(self) -> int:
        return len(self._paths)

    # --- which there are

    def open(self, path_id: int, cost: int, now: float) -> Path:
        """Add a path, or take the one that is there."""
        path = self._paths.get(path_id)
        if path is None:
            if len(self._paths) >= MAX_PATHS:
                spare = [p for p in self if p is not self.choice.active]
                self.close(min(spare, key=lambda p: (p.address is not None, p.heard_at)).id, now)
            path = self._paths[path_id] = Path(path_id, self._config, now)
            path.next_number = self._numbers.pop(path_id, 0)
            if self._up:
                path.start_epoch(now)
            self._sender.use(self, *self.choice, now)
        path.cost = cost
        return path

    def admit(self, path_id: int, message: Frame | None, now: float) -> Path | None:
        """The robot speaks by a path that is not known yet: its ping says so, or there is none other.

        Args:
            path_id: The path.
            message: What it says, if that is a frame.
            now: Time.
        """
        if any(p.address is not None for p in self) and not (isinstance(message, Ping) and message.path == path_id):
            return None
        return self.open(path_id, 0, now)

    def close(self, path_id: int, now: float) -> None:
        """Drop a path; the last one stays, and leads nowhere until another is opened."""
        path = self._paths.get(path_id)
        if path is None or len(self._paths) == 1:
            return
        del self._paths[path_id]
        self._numbers[path_id] = path.next_number
        if path is self._previous:
            self._previous = None
        if path is self.choice.active:
            self._switch(self._best(self, now), "closed", now)
        self.choose(now)
        self._sender.use(self, *self.choice, now)
        if len(self._paths) == 1:  # nobody asks any more, so no answer can be missing
            self.choice.active.liveness.calm()

    def welcomed(self, path_id: int, answered_at: float | None, now: float) -> None:
        """The robot's end: the service has answered, and gets a ping under its keys by every path.

        Args:
            path_id: By which path the answer came.
            answered_at: When the service sent it, by its clock; None: nobody knows what it answered.
            now: Time.
        """
        came_by = self.get(path_id)
        if came_by is not None:
            if came_by.peer is not None:  # it answers what was sent there, wherever the answer comes from
                came_by.address = came_by.peer
            if answered_at is not None:
                came_by.echo = answered_at, now
        for path in self:
            self.ping(path, now)

    def start_epoch(self, now: float) -> None:
        """New keys: all begins anew."""
        self._up = True
        for path in self:
            path.start_epoch(now)

    def end_epoch(self) -> None:
        """No keys: nothing can be said."""
        self._up = False
        for path in self:
            path.ping_at = math.inf
            path.mtu.stop()

    # --- pings

    def ping(self, path: Path, now: float, size: int = 0) -> None:
        """Say that we are there, ask whether the peer is, and how long its latest ping took to be answered."""
        if not self._up:
            return
        path.pinged_at = now
        ask = size > 0 or len(self._paths) > 1
        if ask and not size:
            path.liveness.ask(now)
        said = _ping(path, ask, size, now)
        if not size:  # a probe has the size that it has
            said = said._replace(astray=path.astray(now))
        self._sender.send_frame(path, push_ping(said, max(0, size - PADDING)), now)

    def ping_to(self, address: Hashable, path: Path, now: float) -> None:
        """Tell somebody who seems to be the peer that we are here."""
        self._send_to(address, path, _ping(path, False, 0, now), now)

    def ping_soon(self, path: Path, now: float) -> None:
        """Ping, unless one was sent just now."""
        if now >= path.pinged_at + PING_SPACING:
            self.ping(path, now)

    def _send_to(self, address: Hashable, path: Path, ping: Ping, now: float) -> None:
        """Ping an address at which the peer is not known to be: no more than came from there."""
        path.validation.sent(address, self._sender.send_frame_to(address, path, push_ping(ping), now))

    def report_arrivals(self, now: float) -> None:
        """Tell the peer what arrived, by the paths on which that is much."""
        for path in self._paths.values():
            if path.much_arrived:
                self.ping_soon(path, now)

    def handle_ping(self, ping: Ping, path: Path, sent_at: float, address: Hashable, now: float) -> Exchange | None:
        """Take the peer's ping that came by a path, and answer it where it came from.

        Returns:
            Time stamps, if it answers one of ours.
        """
        first = path.echo is None
        if path.echo is None or sent_at > path.echo[0]:
            path.echo = sent_at, now
            path.apply_feedback(ping.feedback, now)
        path.losses.leave_out(ping.astray)
        if ping.ask:
            echo = round(sent_at * 1e6)
            answer = Ping(path.id, path.cost, False, ping.size, echo, ping.challenge, 0, path.feedback(now))
            if address == path.address:
                self._sender.send_frame(path, push_ping(answer), now)
            else:
                self._send_to(address, path, answer, now)
        elif first:
            self.ping_soon(path, now)  # so that the peer need not wait for its first exchange of time stamps
        if ping.echo is None:
            return None
        if path.validation and not ping.ask and (proven := path.validation.answered(ping.challenge)) is not None:
            self._move(path, *proven, now)
        asked_at, hold = ping.echo / 1e6, ping.hold / 1e6
        rtt = now - asked_at - hold
        if rtt < 0:
            return None
        if ping.size and not ping.ask:
            path.mtu.answer(ping.size if ping.size > PADDING else SMALL)
        if ping.size <= PADDING:  # a long packet takes longer
            path.rtt = rtt
            path.rtts.add(rtt)
            path.liveness.answer(asked_at, rtt, now)
            self.choose(now)
        return Exchange(asked_at, sent_at - hold, sent_at)

    def heard(self, path: Path, number: int, address: Hashable, size: int, now: float, *, proven: bool = False) -> None:
        """An authentic message came by that path; the newest of its messages tells where the peer seems to be.

        Args:
            path: The path.
            number: Of the message.
            address: Where it came from.
            size: Bytes that came.
            now: Time.
            proven: The peer got what was sent to that address.
        """
        if number > path.newest:
            path.newest = number
            if address != path.address:
                if proven:
                    self._move(path, address, path.heard_at, now)
                elif path.validation.packet_came(address, size, path.heard_at, now):
                    challenge = int.from_bytes(self._entropy(CHALLENGE_SIZE)) or 1
                    path.validation.challenge(address, challenge, now)
                    self._send_to(address, path, _ping(path, True, 0, now, challenge), now)
        path.heard_at = now
        if len(self._paths) > 1 and path.liveness.health(now) is Health.DEAD:
            self.ping_soon(path, now)

    def _move(self, path: Path, address: Hashable, since: float, now: float) -> None:
        """The peer is there."""
        moved = path.address is not None
        path.address = address
        path.validation.clear()
        if moved:
            path.mtu.restart(now)
            self._events.append(PeerMoved(address))
            self._sender.repeat(path, since - (path.rtt if path.rtt == path.rtt else 0.0), now)
        self.choose(now)

    # --- time

    def next_timer(self) -> float:
        """When to call `handle_timer`; inf if nothing is due."""
        due = math.inf
        if not self._up:
            return due
        for path in self._paths.values():
            if path.address is not None:
                due = min(due, path.ping_at, path.mtu.due)
        if len(self._paths) > 1:
            now = self._chosen_at
            due = min(due, *(path.liveness.next_change(now) for path in self))
            if self._overlap_until > now:
                due = min(due, self._overlap_until)
        return due

    def handle_timer(self, now: float, silence: float, connected: bool) -> None:
        """Ask and probe what is due, and choose anew.

        Args:
            now: Time.
            silence: Seconds since the peer was heard by any path.
            connected: Whether it counts as connected.
        """
        if not self._up:
            return
        several = len(self._paths) > 1
        for path in list(self):
            if path.address is None:
                continue
            if several and path.liveness.health(now) is Health.SUSPECT:
                path.ping_at = min(path.ping_at, path.pinged_at + HURRY * path.liveness.patience)
            if now >= path.ping_at:
                self.ping(path, now)
                path.ping_at = now + self._interval(path, now, silence, connected)
            if now >= path.mtu.due:
                self._probe(path, now)
        if several:
            self._forget(now)
            self.choose(now)

    def _interval(self, path: Path, now: float, silence: float, connected: bool) -> float:
        config = self._config
        if path.newest < 0 and silence < config.silence:  # the peer may not know of these keys yet, for all we know
            return min(config.keepalive, config.hello_retry)
        if len(self._paths) == 1:
            return config.keepalive if connected else patience(config, silence)
        health = path.liveness.health(now)
        if health is Health.DEAD:
            return patience(config, now - path.heard_at)
        return HURRY * path.liveness.patience if health is Health.SUSPECT else config.keepalive

    def _probe(self, path: Path, now: float) -> None:
        config = self._config
        if now > path.heard_at + 3 * config.keepalive:  # who does not answer tells nothing about sizes
            path.mtu.due = now + config.keepalive
            return
        busy, path.large = path.large, False
        for size in path.mtu.probe(now, path.liveness.patience, busy):
            self.ping(path, now, size or PADDING)

    def _forget(self, now: float) -> None:
        """Paths that robots leave without a word."""
        if any(now - p.heard_at < self._config.silence for p in self):
            for path in [p for p in self if p.peer is None and now - p.heard_at > FORGET_AFTER]:
                self.close(path.id, now)

    def stats(self, overhead: float, redundancy: float, now: float) -> tuple[PathStats, ...]:
        """A snapshot; ``overhead`` and ``redundancy`` are those of all paths."""
        return tuple(
            PathStats(
                p.id, p.address, p.rtt, p.rtts.minimum, p.rtts.quantile(0.5), p.loss_out.share, p.loss_in.share,
                p.loss_in.burst, p.loss_out.burst, p.packets_sent, p.packets_received, p.bytes_sent, p.bytes_received,
                p.pacer.rate * 8, overhead, redundancy, p is self.choice.active, p.liveness.health(now).name.lower(),
                p.cost, p.mtu.size,
            )
            for p in self
        )  # fmt: skip

    # --- choice

    def choose(self, now: float) -> None:
        """Decide where to send from now on."""
        active = self.choice.active
        self._chosen_at = now
        if len(self._paths) == 1:
            only = next(iter(self))
            self._set(PathChoice(only, None, False), "closed" if only is not active else "", now)
            return
        others = [p for p in self if p is not active and p.address is not None]
        best = self._best(others, now) if others else None
        if best is not None:
            reason = self._reason(active, best, now)
            if reason:
                self._switch(best, reason, now)
                active = best
                others = [p for p in self if p is not active and p.address is not None]
        overlap = now < self._overlap_until
        if overlap and self._previous in others and self._previous.liveness.health(now) is not Health.DEAD:
            other: Path | None = self._previous
        else:
            overlap = False
            usable = [p for p in others if p.liveness.health(now) is not Health.DEAD]
            other = self._best(usable, now) if usable else None
        doubled = other is not None and (overlap or active.liveness.health(now) is not Health.LIVE)
        self._set(PathChoice(active, other, doubled), "", now)

    @staticmethod
    def _best(paths: Iterable[Path], now: float) -> Path:
        return min(paths, key=lambda p: (p.address is None, p.liveness.health(now), p.cost, _badness(p), p.id))

    def _reason(self, active: Path, best: Path, now: float) -> str:
        """Why the best of the others should be the active one; empty if it should not."""
        health, theirs = active.liveness.health(now), best.liveness.health(now)
        if active.address is None or (health is Health.DEAD and theirs is not Health.DEAD):
            return "lost"
        stable = self._config.path_stable
        if theirs is not Health.LIVE or now < best.liveness.live_since + stable:
            self._better_since = None
            return ""
        if best.cost != active.cost:
            self._better_since = None
            return "cheaper" if best.cost < active.cost else ""
        share, less = BETTER
        if not _badness(best) < share * _badness(active) - less:
            self._better_since = None
            return ""
        if self._better_since is None or self._better_since[0] is not best:
            self._better_since = best, now
        return "better" if now >= self._better_since[1] + stable else ""

    def _switch(self, path: Path, reason: str, now: float) -> None:
        """Make another path the active one; the one before goes on for a while."""
        self._previous = self.choice.active if reason != "closed" else None
        self._overlap_until = now + self._config.path_overlap
        self._better_since = None
        self._set(PathChoice(path, self._previous, self._previous is not None), reason, now)

    def _set(self, choice: PathChoice, reason: str, now: float) -> None:
        if choice != self.choice:
            self.choice = choice
            self._sender.use(self, *choice, now)
            if reason and self._up:
                self._events.append(PathSwitched(choice.active.id, reason))


def _ping(path: Path, ask: bool, size: int, now: float, challenge: int = 0) -> Ping:
    """A question, or only the answer to the peer's latest."""
    if path.echo is None:
        echo, hold = None, 0
    else:
        echo, hold = round(path.echo[0] * 1e6), int((now - path.echo[1]) * 1e6)
    return Ping(path.id, path.cost, ask, size, echo, challenge, hold, path.feedback(now))


def _badness(path: Path) -> float:
    """Seconds of delay that a path is as bad as."""
    rtt = path.liveness.srtt
    if math.isnan(rtt):
        return math.inf
    loss = path.loss_out.share
    return rtt + LOSS_WEIGHT * (loss if loss == loss else 0.0)
