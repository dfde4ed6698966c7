"""Calls of a service: those of the robot that it answers, between its steps, and those that it makes itself."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, Protocol, TypeVar

from skytether.messages import DecodeError, Encoding, Message, ServiceType, decode, encode

from .errors import CallError

Q = TypeVar("Q", bound=Message)
A = TypeVar("A", bound=Message)
T = TypeVar("T")

DEFAULT_TIMEOUT = 5.0
"""Seconds that the robot may take to answer, unless told otherwise."""
ASKERS = 8
"""Calls of a service that may be in flight; more wait for their turn."""


class CallPublisher(Protocol):
    """The bridge, as far as calls need it; see `skytether.bridge.Bridge`."""

    def call(self, name: str, payload: bytes | memoryview, timeout: float) -> bytes: ...
    def answer(self, name: str, handler: Callable[[bytes], bytes]) -> None: ...


class Spawn(Protocol):
    """Runs something beside the service's thread."""

    def __call__(self, work: Callable[[], T], /) -> Future[T]: ...


class Threads:
    """A few threads, made when the first is needed."""

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None

    def __call__(self, work: Callable[[], T], /) -> Future[T]:
        if self._pool is None:
            self._pool = ThreadPoolExecutor(ASKERS, thread_name_prefix="asks")
        return self._pool.submit(work)

    def close(self) -> None:
        """What has not begun does not begin any more."""
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)


class Caller(Generic[Q, A]):
    """One kind of call that the robot answers."""

    def __init__(self, name: str, srv: ServiceType[Q, A]) -> None:
        self.name = name
        self.encoding: Encoding | None = None
        """As the robot wants it; None while there is no robot, or one that does not answer this call."""
        self.publisher: CallPublisher | None = None
        self.spawn: Spawn | None = None
        self.srv = srv

    def ask(self, request: Q, timeout: float = DEFAULT_TIMEOUT) -> Future[A]:
        """Ask the robot. Never blocks; a step looks at ``done()`` of what it got, `start` may wait for ``result()``.

        Args:
            request: What is asked; encoded here.
            timeout: Seconds, after which ``result()`` raises.

        Returns:
            The answer to come. Its ``result()`` raises `CallError` if there is none; the text says why.

        Raises:
            TypeError: The request is of another type than the call.
            EncodeError: A value in it does not fit its type.
        """
        srv = self.srv
        if type(request) is not srv.request:
            raise TypeError(f"call {self.name} asks by {srv.request.TYPE}, not {type(request).__name__}")
        publisher, encoding, spawn = self.publisher, self.encoding, self.spawn
        if publisher is None or encoding is None or spawn is None:
            nobody: Future[A] = Future()
            nobody.set_exception(CallError(f"call '{self.name}': no robot is there that answers it"))
            return nobody
        payload = encode(request, encoding)
        return spawn(lambda: self._ask(publisher, payload, encoding, timeout))

    def _ask(self, publisher: CallPublisher, payload: bytes, encoding: Encoding, timeout: float) -> A:
        """In a thread of its own."""
        from skytether.bridge import CallError as Failed  # not before there is a bridge: it takes long to import

        try:
            return decode(self.srv.response, publisher.call(self.name, payload, timeout), encoding)
        except (Failed, ValueError) as error:  # no answer, no such message, or too large
            raise CallError(str(error)) from error


@dataclass(frozen=True, slots=True, eq=False)
class Asked:
    """A call of the robot that waits for the service's thread."""

    name: str
    payload: bytes
    encoding: Encoding
    answer: Future[bytes]


class Desk:
    """Where the robot's calls wait until the service's thread has time for them.

    Args:
        wake: Ends the sleep of the service's thread.
    """

    def __init__(self, wake: Callable[[], None]) -> None:
        self._wake = wake
        self._handlers: dict[str, tuple[ServiceType[Any, Any], Callable[[Any], Any]]] = {}
        self._waiting: deque[Asked] = deque()
        self._later: set[Asked] = set()
        self._lock = threading.Lock()
        self._closed = False

    @property
    def names(self) -> tuple[str, ...]:
        """Calls that are answered here."""
        return tuple(self._handlers)

    def open(self, name: str, srv: ServiceType[Q, A], handler: Callable[[Q], A | Future[A]]) -> None:
        """Have a call answered by a function, now or (a future that is set in the service's thread) later."""
        self._handlers[name] = (srv, handler)

    def ask(self, name: str, payload: bytes, encoding: Encoding) -> Future[bytes]:
        """From any thread: leave a call."""
        asked = Asked(name, payload, encoding, Future())
        with self._lock:
            if self._closed:
                asked.answer.set_exception(CallError("the service ends"))
            else:
                self._waiting.append(asked)
                self._wake()
        return asked.answer

    def work(self) -> None:
        """In the service's thread: answer what waits. What a handler raises ends the service, as in a step."""
        while self._waiting:
            asked = self._waiting.popleft()
            srv, handler = self._handlers[asked.name]
            try:
                answer = handler(decode(srv.request, asked.payload, asked.encoding))
                if isinstance(answer, Future):
                    self._later.add(asked)
                    answer.add_done_callback(partial(self._finish, asked, srv))
                else:
                    asked.answer.set_result(_encoded(asked, srv, answer))
            except (CallError, DecodeError) as error:
                asked.answer.set_exception(CallError(str(error)))
            except BaseException as error:
                asked.answer.set_exception(CallError(f"its handler failed: {type(error).__name__}"))
                raise

    def _finish(self, asked: Asked, srv: ServiceType[Any, Any], answer: Future[Any]) -> None:
        """What was to be answered later is answered now, in the service's thread."""
        if asked not in self._later:
            return  # closed meanwhile
        self._later.remove(asked)
        try:
            asked.answer.set_result(_encoded(asked, srv, answer.result()))
        except (CallError, ValueError, TypeError) as error:
            asked.answer.set_exception(CallError(str(error)))

    def close(self) -> None:
        """Nobody answers any more."""
        with self._lock:
            self._closed = True
        while self._later:
            self._later.pop().answer.set_exception(CallError("the service ends"))
        while self._waiting:
            self._waiting.popleft().answer.set_exception(CallError("the service ends"))


def _encoded(asked: Asked, srv: ServiceType[Any, Any], answer: Message) -> bytes:
    if type(answer) is not srv.response:
        raise TypeError(f"call {asked.name} is answered by {srv.response.TYPE}, not {type(answer).__name__}")
    return encode(answer, asked.encoding)
