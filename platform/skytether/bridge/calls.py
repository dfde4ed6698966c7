"""Request and response over a session: what ROS calls a service call. Carried on a pair of reliable topics.

A call NAME is the topics ``NAME/request`` and ``NAME/response``, both reliable, one each way. A request starts with a
number that the caller chose, its answer with the same number and whether it is an answer or a failure told in a
sentence. A call may fail although it was carried out: its answer may have been lost with the one who gave it.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import logging
import struct
import threading
from collections.abc import Callable, Iterable

from skytether.wire.events import Connected, Disconnected, Event, MessageReceived
from skytether.wire.topic import Role, Topic

_log = logging.getLogger(__name__)

REQUEST, RESPONSE = "/request", "/response"
_REQUEST = struct.Struct(">Q")
_RESPONSE = struct.Struct(">QB")
_ANSWERED, _FAILED = 0, 1
MAX_PENDING = 1000
"""Calls of this end that may wait for an answer."""
MAX_WORKING = 64
"""Calls of the peer that may be worked on or wait for it."""
MAX_WORKING_BYTES = 64 << 20
"""Of them all together: a compressed call of half a kilobyte may grow to 16 MiB."""
WORKERS = 16
"""Handlers that run at the same time; the result of an action of ROS 2 is a call that waits as long as the action."""

Handler = Callable[[bytes], bytes]
Publish = Callable[[str, bytes], bool]


class CallError(Exception):
    """A call has no answer; the text says why. A handler raises it to have its text told to the caller."""


class CallTimeoutError(CallError):
    """Nothing came in time. It may have been carried out all the same."""


class CallFailedError(CallError):
    """The other end, or the session, failed."""


def call_names(topics: Iterable[Topic]) -> dict[str, Role]:
    """Calls among the topics of a table, and which end makes them."""
    reliable = {t.name: t.direction.sender for t in topics if t.reliable}
    return {
        name.removesuffix(REQUEST): role
        for name, role in reliable.items()
        if name.endswith(REQUEST) and reliable.get(name.removesuffix(REQUEST) + RESPONSE) not in (None, role)
    }


class Calls:
    """Both halves at one end: calls that it makes, calls that it answers.

    Attributes:
        late: Answers that came when nobody waited for them any more.

    Args:
        topics: This end's table.
        role: Which end.
        publish: Sends a message; safe from any thread.
        first: Number of the first call; random, so that a restarted end takes no answer for one of its own.
    """

    def __init__(self, topics: Iterable[Topic], role: Role, publish: Publish, first: int) -> None:
        names = call_names(topics)
        self.made = frozenset(n for n, caller in names.items() if caller is role)
        self.answered = frozenset(n for n, caller in names.items() if caller is not role)
        self.late = 0
        self._publish = publish
        self._next = first
        self._lock = threading.Lock()
        self._pending: dict[int, concurrent.futures.Future[bytes]] = {}
        self._handlers: dict[str, Handler] = {}
        self._working = self._working_bytes = 0
        self._closed = False
        self._workers: concurrent.futures.ThreadPoolExecutor | None = None

    def call(self, name: str, payload: bytes | memoryview, timeout: float) -> bytes:
        """See `Bridge.call`."""
        if name not in self.made:
            raise KeyError(f"call '{name}' is not one that this end makes; it may be one of: {_listed(self.made)}")
        answer: concurrent.futures.Future[bytes] = concurrent.futures.Future()
        with self._lock:
            if self._closed:
                raise CallFailedError(f"call '{name}': the bridge is stopped")
            if len(self._pending) >= MAX_PENDING:
                raise CallFailedError(f"call '{name}': {MAX_PENDING} calls wait for an answer already")
            number = self._next
            self._next = (number + 1) % 2**64
            self._pending[number] = answer
        try:
            if not self._publish(name + REQUEST, _REQUEST.pack(number) + payload):
                raise CallFailedError("the other end does not know it, or the bridge was not started")
            return answer.result(timeout)
        except CallFailedError as error:
            raise CallFailedError(f"call '{name}': {error}") from None
        except concurrent.futures.TimeoutError:
            raise CallTimeoutError(f"call '{name}': no answer within {timeout:g} s") from None
        finally:
            with self._lock:
                self._pending.pop(number, None)

    def answer(self, name: str, handler: Handler) -> None:
        """See `Bridge.answer`."""
        if name not in self.answered:
            raise KeyError(
                f"call '{name}' is not one that this end answers; it may be one of: {_listed(self.answered)}"
            )
        self._handlers[name] = handler

    def deliver(self, message: MessageReceived) -> bool:
        """From the bridge's thread: take a message if it belongs to a call."""
        topic = message.topic
        if topic.endswith(RESPONSE) and (name := topic.removesuffix(RESPONSE)) in self.made:
            self._on_response(bytes(message.payload))
        elif topic.endswith(REQUEST) and (name := topic.removesuffix(REQUEST)) in self.answered:
            self._on_request(name, bytes(message.payload))
        else:
            return False
        return True

    def notify(self, event: Event) -> None:
        """From the bridge's thread: a peer that is gone for good answers nothing."""
        if isinstance(event, Connected) and event.restarted:
            self.fail("the other end was restarted; nobody knows whether it was carried out")
        elif isinstance(event, Disconnected) and event.reason == "goodbye":
            self.fail("the session was ended; nobody knows whether it was carried out")

    def fail(self, reason: str) -> None:
        """Have all calls in flight fail."""
        with self._lock:
            pending, self._pending = self._pending, {}
        for answer in pending.values():
            answer.set_exception(CallFailedError(reason))

    def close(self) -> None:
        """The bridge is stopped; handlers that run are not waited for."""
        with self._lock:
            self._closed = True
        self.fail("the bridge is stopped")
        if self._workers is not None:
            self._workers.shutdown(wait=False, cancel_futures=True)

    def _on_response(self, data: bytes) -> None:
        if len(data) < _RESPONSE.size:
            return
        number, outcome = _RESPONSE.unpack_from(data)
        with self._lock:
            answer = self._pending.pop(number, None)
        if answer is None:
            self.late += 1
        elif outcome == _ANSWERED:
            answer.set_result(data[_RESPONSE.size :])
        else:
            answer.set_exception(CallFailedError(data[_RESPONSE.size :].decode(errors="replace")))

    def _on_request(self, name: str, data: bytes) -> None:
        if len(data) < _REQUEST.size:
            return
        (number,) = _REQUEST.unpack_from(data)
        handler = self._handlers.get(name)
        if handler is None:
            self._respond(name, number, _FAILED, b"nobody answers it at the other end")
            return
        with self._lock:
            busy = self._working >= MAX_WORKING or self._working_bytes + len(data) > MAX_WORKING_BYTES
            if not busy:
                self._working += 1
                self._working_bytes += len(data)
        if busy:
            self._respond(name, number, _FAILED, b"the other end has too many calls to answer; try again later")
            return
        if self._workers is None:
            self._workers = concurrent.futures.ThreadPoolExecutor(WORKERS, thread_name_prefix="calls")
        with contextlib.suppress(RuntimeError):  # the bridge is being stopped
            self._workers.submit(self._work, name, number, handler, data[_REQUEST.size :])

    def _work(self, name: str, number: int, handler: Handler, payload: bytes) -> None:
        """In a worker's thread."""
        try:
            outcome, answer = _ANSWERED, bytes(handler(payload))
        except CallError as error:
            outcome, answer = _FAILED, str(error).encode()
        except Exception as error:
            _log.exception("The handler of call '%s' failed", name)
            outcome, answer = _FAILED, f"its handler failed: {type(error).__name__}".encode()
        finally:
            with self._lock:
                self._working -= 1
                self._working_bytes -= _REQUEST.size + len(payload)
        self._respond(name, number, outcome, answer)

    def _respond(self, name: str, number: int, outcome: int, answer: bytes) -> None:
        try:
            self._publish(name + RESPONSE, _RESPONSE.pack(number, outcome) + answer)
        except ValueError as error:  # too large
            self._publish(name + RESPONSE, _RESPONSE.pack(number, _FAILED) + str(error).encode())


def _listed(names: Iterable[str]) -> str:
    return ", ".join(sorted(names)) or "(none)"
