"""What we are on a ROS 2 graph through rclpy, one object each; the node's program (`side`) has the real ones."""

from __future__ import annotations

import base64
import itertools
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Collection
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NoAnswer
from math import inf
from typing import Protocol

from skytether.bridge.calls import CallError

from ...velocities import VELOCITIES
from ..dialect import Endpoint
from ..qos import Qos, follow, history_missed
from .overrun import QUIET_S, Overrun
from .side.frames import (
    FIRST_WORD,
    FOR_ALL,
    Frame,
    Kind,
    control,
    fresh,
    numbered,
    pull_dealt_with,
    pull_fresh,
    pull_number,
)
from .side.outbox import Sender

_log = logging.getLogger(__name__)

MAX_WAITING = 1000
"""Messages that wait for the node's program where none may be dropped."""
_LATELY_S = 1.0
"""What the program said longer ago is of before a pause in the publishing."""
MAX_CALLS = 64
"""Requests and answers that wait for it."""


class Host(Protocol):
    """The node, as its endpoints see it."""

    def remove(self, handle: Handle) -> None:
        """Have the graph without it."""
        ...

    def work(self, job: Callable[[], object]) -> bool:
        """Have something done that may take its time; False if too much is being done already."""
        ...

    def report(self, key: str, text: str) -> None:
        """Tell a trouble once."""
        ...


class Handle:
    """One endpoint of ours.

    Attributes:
        endpoint: What it is.
        channel: Its number on the socket.
        refused: Why nothing is carried: a sentence, or empty.
        passed: Messages of a topic that were given on.
        dropped: Messages that could not be given on.
    """

    def __init__(self, host: Host, channel: int, endpoint: Endpoint) -> None:
        self.endpoint = endpoint
        self.channel = channel
        self.refused = ""
        self.passed = 0
        self.dropped = 0
        self._host = host
        self._sender: Sender | None = None

    def close(self) -> None:
        """Leave the graph; from any thread, and again."""
        self._host.remove(self)

    def join(self, sender: Sender) -> None:
        """The program is started: become part of the graph."""
        self._sender = sender

    def begin(self) -> None:
        """The program is our node."""

    def leave(self) -> None:
        """The program is gone."""
        self._sender = None

    def on_frame(self, frame: Frame) -> None:
        """In the node's thread: a frame of this channel came."""

    def review(self, others: Collection[Endpoint]) -> None:
        """In the node's thread: these are the endpoints of others that go with this one."""

    def lose(self, count: int) -> None:
        """In the node's thread: so many more messages did not come, for they came too quickly."""
        self.dropped += count


class Publication(Handle):
    """A publisher; see `skytether.ros.ros2.seam.GraphNode.publish`."""

    def __init__(
        self,
        host: Host,
        channel: int,
        endpoint: Endpoint,
        *,
        waits: bool = False,
        farewell: bytes = b"",
        farewell_after_s: float = 0.0,
        fresh_s: float = inf,
        stuck_s: float | None = None,
        awaited: Collection[str] = (),
    ) -> None:
        super().__init__(host, channel, endpoint)
        self._waits = waits
        self._awaited = awaited
        self._farewell = farewell
        self._farewell_after_s = farewell_after_s
        self._fresh_s = fresh_s
        self._stuck_s = fresh_s if stuck_s is None else stuck_s
        self._lock = threading.Lock()
        self._numbers = itertools.count(1)
        self._waiting: deque[tuple[int, float]] = deque()
        """Number and time [s] of each that the program has not dealt with, where `fresh_s` says how old one may get."""
        self._unheard: deque[tuple[int, float]] = deque(maxlen=MAX_WAITING)
        """The same of those that it has dealt with, and nobody is known to have acknowledged."""
        self._unread: tuple[float, float] = (0.0, 0.0)
        """When the program said for how long what was published is unread, and that [s]."""
        self._published = 0
        """Of those, as this program counts them."""
        self.left_at = -inf
        """When the last was put that is known to have been published, of those with `fresh_s` [s]."""
        self.heard_at = -inf
        """The same, and to have been acknowledged by all who do that in time [s]."""
        self.lost = False
        """Whether the program has dealt with the last of those, and not published it."""
        self._heard = False
        self.renewed = 0
        """See `skytether.ros.ros2.seam.Publication.renewed`."""
        self._begun = False
        """Whether the program is our node; where only the newest counts, none that may not wait is put before."""
        self._kept: bytes | None = None
        """The newest message of a transient-local topic, for when the program runs again."""

    def put(
        self, payload: bytes | memoryview, until: float = inf, renewed: int | None = None, *, first: bool = False
    ) -> bool:
        """See `skytether.ros.ros2.seam.Publication.put`."""
        body = bytes(payload)
        if self.endpoint.qos.transient_local:
            self._kept = body
        sender, early = self._sender, self._fresh_s < inf and not self._waits and not self._begun
        if sender is None or early or self.refused or self.stuck:
            with self._lock:
                self.dropped += 1
            return False
        if self._fresh_s < inf:  # what becomes of each the program tells, or its end
            sender.put(self._fresh(body, until, FIRST_WORD if first else renewed))
            return True
        pushed_out = sender.put(Frame(Kind.DATA, self.channel, body))  # an older one of this topic
        self.dropped += pushed_out
        self.passed += 1 - pushed_out
        return True

    @property
    def stuck(self) -> bool:
        """Whether the program has not dealt with one for longer than it may wait; then none is taken."""
        with self._lock:
            return bool(self._waiting) and not 0 <= _now() - self._waiting[0][1] <= self._stuck_s

    @property
    def unread_s(self) -> float:
        """For how long somebody who listens, and did, has not acknowledged what is published [s].

        Known while messages with `fresh_s` are published, of who is reliable, and acknowledges each before the next.
        """
        with self._lock:
            at, unread_s = self._unread
        return unread_s if 0 <= _now() - at <= _LATELY_S else 0.0

    @property
    def heard(self) -> bool:
        """See `skytether.ros.ros2.seam.Publication.heard`; known once a message with `fresh_s` was published."""
        return self._heard

    def _fresh(self, body: bytes, until: float, renewed: int | None) -> Frame:
        with self._lock:
            number, now = next(self._numbers), _now()
            self._waiting.append((number, now))
            until = min(until, now + self._fresh_s, self._waiting[0][1] + self._stuck_s)
            if renewed is None:
                renewed = self.renewed if self._heard else FOR_ALL
            return fresh(self.channel, number, until, renewed, body)

    def on_frame(self, frame: Frame) -> None:
        done = pull_dealt_with(frame.body)
        with self._lock:
            self._heard, self.renewed = done.hears, done.renewed
            self._unread = (_now(), done.unread_s)
            new, self._published = done.published - self._published, done.published
            over = 0
            while self._waiting and self._waiting[0][0] <= done.number:
                number, at = self._waiting.popleft()
                over += 1
                self.lost = number > done.newest
                self._unheard.append((number, at))
                if number == done.newest:
                    self.left_at = at
            while self._unheard and self._unheard[0][0] <= done.heard:
                self.heard_at = self._unheard.popleft()[1]
            self.passed += new
            self.dropped += over - new  # too old, or a newer one came before their turn

    def begin(self) -> None:
        self._begun = True

    def leave(self) -> None:
        self._begun = False
        super().leave()
        self._forget()

    def _forget(self) -> None:
        """What waited in the program that is gone: nobody tells any more what became of it."""
        with self._lock:
            self.dropped += len(self._waiting)
            self._waiting.clear()
            self._unheard.clear()
            self._unread = (0.0, 0.0)
            self._published = 0
            self._heard = False

    def join(self, sender: Sender) -> None:
        self._forget()  # one may have been put in the moment of the end
        ours = self.endpoint
        depth = max(ours.qos.depth, MAX_WAITING) if self._waits else ours.qos.depth
        sender.set(self.channel, ours.priority, depth)
        sender.put(
            control(
                do="publish",
                channel=self.channel,
                name=ours.name,
                kind=ours.type,
                reliable=ours.qos.reliable,
                transient_local=ours.qos.transient_local,
                depth=ours.qos.depth,
                farewell=base64.b64encode(self._farewell).decode(),
                farewell_after_s=self._farewell_after_s,
                lifespan_s=self._fresh_s if self._fresh_s < inf else None,
                awaited=list(self._awaited),
            )
        )
        if self._kept is not None:
            sender.put(Frame(Kind.DATA, self.channel, self._kept))
        super().join(sender)


class Subscription(Handle):
    """A subscription; it is made when somebody publishes, with the quality that is offered, and follows changes."""

    def __init__(
        self,
        host: Host,
        channel: int,
        endpoint: Endpoint,
        take: Callable[[bytes], object],
        lose: Callable[[int], object] | None = None,
        *,
        every_kept: bool = False,
    ) -> None:
        super().__init__(host, channel, endpoint)
        self._every_kept = every_kept
        self._on_message = take
        self._lose = lose
        self._lost = 0
        self._stale_at = -inf
        """When the last message came that had waited for one of our processes that stood still [s]."""
        self._overrun = Overrun(endpoint.qos.depth)
        self._asked: tuple[Qos, bool] | None = None

    def join(self, sender: Sender) -> None:
        self._asked = None
        sender.put(control(do="watch", channel=self.channel, name=self.endpoint.name))
        super().join(sender)

    def review(self, others: Collection[Endpoint]) -> None:
        offers = [other.qos for other in others]
        kept_too = self.endpoint.type not in VELOCITIES  # of any age
        wanted = follow(self.endpoint.qos, offers, kept_too=kept_too) if offers else None
        besides = self._every_kept and history_missed(offers)
        sender = self._sender
        if sender is None or wanted is None or (wanted, besides) == self._asked:
            return
        self._asked = wanted, besides
        ours = self.endpoint
        sender.put(
            control(
                do="subscribe",
                channel=self.channel,
                name=ours.name,
                kind=ours.type,
                reliable=wanted.reliable,
                transient_local=wanted.transient_local,
                depth=wanted.depth,
                priority=ours.priority,
                keep=ours.qos.depth,
                besides=besides,
            )
        )

    def on_frame(self, frame: Frame) -> None:
        if self.refused:
            self.dropped += 1
            return
        body = frame.body
        if frame.kind is Kind.FRESH:
            _, until, _, body = pull_fresh(body)
            if _now() > until:  # this process stood still
                self.discard(1)
                return
        self.passed += 1
        try:
            self._on_message(body)
        except Exception:  # the node's thread must live on
            _log.exception("A message of %s was lost", self.endpoint.name)

    def lose(self, count: int) -> None:
        super().lose(count)
        self._lost += count
        if self._lose is not None:
            self._lose(count)

    def discard(self, count: int) -> None:
        """In the node's thread: so many more messages are not taken, for a process of ours stood still."""
        self.dropped += count
        self._stale_at = _now()
        if self._lose is not None:
            self._lose(count)

    def stood_still(self) -> str:
        """A sentence if messages were not taken because of that; empty if not, or a while ago."""
        if _now() - self._stale_at > QUIET_S:
            return ""
        return f"{self.endpoint.name}: our end, or its program, stood still; what came meanwhile is not taken"

    def overrun(self, now: float) -> str:
        """A sentence if messages come quicker than they are taken; empty if not, or not any more. ``now`` in s."""
        found = self._overrun.update(self.passed, self._lost, now)
        name = self.endpoint.name
        how = "publish them less often, or give the topic's row more depth"
        return f"{name}: messages come quicker than they are taken: {found}; {how}" if found else ""


class Server(Handle):
    """A service; its function answers, in threads of its own, and raises `CallError` where it cannot."""

    def __init__(self, host: Host, channel: int, endpoint: Endpoint, answer: Callable[[bytes], bytes]) -> None:
        super().__init__(host, channel, endpoint)
        self._answer = answer

    def join(self, sender: Sender) -> None:
        ours = self.endpoint
        sender.set(self.channel, ours.priority, MAX_CALLS)
        sender.put(control(do="serve", channel=self.channel, name=ours.name, kind=ours.type, priority=ours.priority))
        super().join(sender)

    def on_frame(self, frame: Frame) -> None:
        number, request = pull_number(frame.body)
        if self.refused:
            self._fail(number, self.refused)
        elif not self._host.work(lambda: self._work(number, request)):
            self._fail(number, "too many calls at the same time")

    def _work(self, number: int, request: bytes) -> None:
        try:
            response = self._answer(request)
        except CallError as error:
            self._fail(number, str(error))
            return
        except Exception as error:
            _log.exception("A call of %s failed", self.endpoint.name)
            self._fail(number, type(error).__name__)
            return
        sender = self._sender
        if sender is not None:
            sender.put(numbered(Kind.RESPONSE, self.channel, number, response))

    def _fail(self, number: int, why: str) -> None:
        """DDS has no word for a failure: who asked is not answered, so it is told here."""
        self.dropped += 1
        self._host.report(f"call {self.endpoint.name}", f"{self.endpoint.name}: a call was not answered: {why}")
        sender = self._sender
        if sender is not None:
            sender.put(numbered(Kind.FAILURE, self.channel, number, why.encode()))


class Client(Handle):
    """A client of a service."""

    def __init__(self, host: Host, channel: int, endpoint: Endpoint) -> None:
        super().__init__(host, channel, endpoint)
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._waiting: dict[int, Future[bytes]] = {}

    def call(self, request: bytes, timeout: float) -> bytes:
        """See `skytether.ros.ros2.seam.Client.call`."""
        name, sender = self.endpoint.name, self._sender
        if self.refused:
            raise CallError(self.refused)
        if sender is None:
            raise CallError(f"{name}: the ROS 2 graph is out of reach")
        number, answer = next(self._numbers), Future[bytes]()
        with self._lock:
            self._waiting[number] = answer
        try:
            sender.put(numbered(Kind.REQUEST, self.channel, number, request))
            return answer.result(timeout)
        except NoAnswer:
            sender.put(control(do="forget", channel=self.channel, number=number))
            raise CallError(f"{name}: no answer within {timeout:g} s") from None
        finally:
            with self._lock:
                self._waiting.pop(number, None)

    def join(self, sender: Sender) -> None:
        ours = self.endpoint
        sender.set(self.channel, ours.priority, MAX_CALLS)
        sender.put(control(do="client", channel=self.channel, name=ours.name, kind=ours.type, priority=ours.priority))
        super().join(sender)

    def leave(self) -> None:
        super().leave()
        with self._lock:
            waiting, self._waiting = self._waiting, {}
        for answer in waiting.values():
            answer.set_exception(CallError(f"{self.endpoint.name}: the ROS 2 graph was lost"))

    def on_frame(self, frame: Frame) -> None:
        number, body = pull_number(frame.body)
        with self._lock:
            answer = self._waiting.pop(number, None)
        if answer is None:
            return
        if frame.kind is Kind.RESPONSE:
            answer.set_result(body)
        else:
            answer.set_exception(CallError(body.decode(errors="replace")))


def _now() -> float:
    """Of the clock that the program has, too [s]."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)
