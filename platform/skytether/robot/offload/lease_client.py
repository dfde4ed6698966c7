"""The robot's side of REST: asks for a service, keeps the lease, notices what changed. Never in the way of driving.

The orchestrator may be away, come back, lose the instance, or refuse the token: each is said once, the asking goes on
with back-off, and a bridge that is up is left alone. `LeaseClient.step` is one exchange and says when the next is due;
`run` is the loop for a thread.
"""

from __future__ import annotations

import logging
import math
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from random import Random
from typing import Protocol

from skytether.api.client import ApiError, Unreachable
from skytether.api.rest import Instance, InstanceCreate, Renew, Report, State

from .backoff import Backoff

_log = logging.getLogger(__name__)

_POLL_S = 0.03
"""Between looks at an instance that is coming up, at first: a start takes some hundred milliseconds."""
_POLL_SHARE, _POLL_MOST_S = 0.05, 0.25
"""Later this share of the time that it has taken so far, at most so many seconds: whoever waits long for an image asks
no more than is good for the others."""
_LOOK_S = 0.2
"""Until the first look when the link went bad: the service may have come back at another address."""
_REFUSED_S = 10.0
"""Before a refused token is tried again: an operator has to act."""
_IDLE_S = 0.5
"""Between looks whether the service is wanted again."""
_MOVING_S = 0.05
"""Between looks at an instance that is to take over, at first."""
_LONGEST = 1000
"""Characters of a trouble: the orchestrator's reasons are part of it."""
_MOVE_S = 20.0
"""An instance elsewhere that is not running by then is given up; the one that runs is kept."""


class Orchestrator(Protocol):
    """What the lease client needs of `skytether.api.client.Client`; every call raises ApiError or Unreachable."""

    def create_instance(self, request: InstanceCreate, *, idempotency_key: str) -> Instance:
        """Ask for a service; the same key gives the same instance."""
        ...

    def get_instance(self, instance_id: str) -> Instance:
        """Look."""
        ...

    def renew_instance(self, instance_id: str, renew: Renew) -> Instance:
        """Keep the lease and report."""
        ...

    def claim_session(self, instance_id: str, claim: str) -> str:
        """The key of its session; the same claim gives it again."""
        ...

    def delete_instance(self, instance_id: str) -> object:
        """Let go."""
        ...


class _KeyTakenError(Exception):
    """The key of an instance's session was handed out to somebody else."""

    def __init__(self, instance: Instance, text: str) -> None:
        self.instance = instance
        super().__init__(text)


@dataclass(frozen=True, slots=True)
class Wanted:
    """What the robot wants at the moment of one exchange.

    Attributes:
        request: As it would be made now; None while the service is not wanted: an instance that is held is let go.
        site: Where the instance should run; None: where it is. One that runs at another site is kept until one there
            serves the robot.
        serving: Id of the instance that serves the robot now; the one before it can be let go.
        healthy: Whether the link is good; while it is not, the address is looked at more often.
    """

    request: InstanceCreate | None
    site: str | None = None
    serving: str | None = None
    healthy: bool = True


@dataclass(frozen=True, slots=True)
class InstanceReported:
    """An answer about an instance that is coming up or running.

    Attributes:
        instance: As the orchestrator told of it, with its session's key.
    """

    instance: Instance


@dataclass(frozen=True, slots=True)
class MoveFailed:
    """There is no instance elsewhere.

    Attributes:
        kept: The instance that is kept instead.
        reason: Why, in one sentence.
    """

    kept: Instance
    reason: str


LeaseEvent = InstanceReported | MoveFailed


class LeaseClient:
    """Wants one instance of a service to run, for as long as it is asked to.

    Args:
        client: The orchestrator.
        report: What to say with each renewal.
        another_token: Looks for a newer token when one was refused; True if there is another one to try.
        renew_s: Time between renewals [s].
        clock: Monotonic seconds.
        random: For the jitter of the back-off.
    """

    def __init__(
        self,
        client: Orchestrator,
        *,
        report: Callable[[], Report | None] = lambda: None,
        another_token: Callable[[], bool] = lambda: False,
        clock: Callable[[], float] = time.monotonic,
        renew_s: float = 2.0,
        random: Random | None = None,
    ) -> None:
        self._client = client
        self._report = report
        self._another_token = another_token
        self._clock = clock
        self._events: deque[LeaseEvent] = deque()
        self._next: tuple[Instance, float] | None = None
        """An instance elsewhere that is coming up, and when it was asked for."""
        self._renew_s = renew_s
        random = random or Random()
        self._backoff = Backoff(0.2, 5.0, random)
        self._looks = Backoff(min(_LOOK_S, renew_s), renew_s, random)
        self._key = str(uuid.uuid4())
        self._claim = str(uuid.uuid4())
        self._keys: dict[str, str] = {}
        """Of the sessions of the instance that is held and the one that is coming, by instance."""
        self._instance: Instance | None = None
        self._renewed_at = self._asked_at = -math.inf
        self._trouble = ""

    @property
    def trouble(self) -> str:
        """What stands in the way now, in one sentence; empty while all is well."""
        return self._trouble

    def next_event(self) -> LeaseEvent | None:
        """The oldest event not yet taken."""
        return self._events.popleft() if self._events else None

    def step(self, wanted: Wanted) -> float:
        """One exchange with the orchestrator; `next_event` has what came of it.

        Args:
            wanted: What the robot wants now, the events before considered.

        Returns:
            Seconds until the next is due.
        """
        self._take_over(wanted.serving)
        request = wanted.request
        if request is None:
            self.release()
            return self._set_trouble("", _IDLE_S)
        held = self._instance
        try:
            instance = self._with_key(self._exchange(request))
        except _KeyTakenError as error:
            self._let_go(error.instance)
            return self._lost(str(error))
        except Unreachable as error:
            return self._set_trouble(str(error), self._backoff.next())
        except ApiError as error:
            return self._refused(error, request.service)
        if instance.state.final or instance.state is State.STOPPING:
            reason = f": {instance.reason}" if instance.reason else ""
            return self._lost(f"instance {instance.id} is {instance.state}{reason}")
        self._instance = instance
        self._events.append(InstanceReported(instance))
        running = instance.state is State.RUNNING
        if running:
            self._backoff.reset()
            self._trouble = ""
        if self._next is not None or instance.successor or (running and _elsewhere(held, instance, wanted.site)):
            return self._move(instance, request)
        if not running:
            return _poll(_POLL_S, self._clock() - self._asked_at)
        if not wanted.healthy:
            return self._looks.next()
        self._looks.reset()
        return self._renew_s

    def run(self, stop: threading.Event, turn: Callable[[], float]) -> None:
        """Take turns until told to stop; trouble is logged, each once.

        Args:
            stop: Ends it.
            turn: One `step` and what follows from its events; returns the seconds until the next is due.
        """
        delay = 0.0
        told = ""
        while not stop.wait(delay):
            try:
                delay = turn()
            except Exception as error:  # a robot must not stop asking because of one strange answer
                _log.debug("asking failed", exc_info=error)
                delay = self._set_trouble(f"asking failed unexpectedly: {error!r}", self._backoff.next())
            if self._trouble and self._trouble != told:
                _log.warning("%s", self._trouble)
            told = self._trouble

    def release(self) -> str | None:
        """Report for the last time and let the instance go; if nobody answers, the end of its lease frees it.

        Returns:
            The instance's id, if there was one and the orchestrator took it back.
        """
        released, self._instance = self._instance, None
        coming, self._next = self._next, None
        if coming is not None:
            self._let_go(coming[0])
        return self._let_go(released, self._report())

    def _let_go(self, instance: Instance | None, report: Report | None = None) -> str | None:
        if instance is None:
            return None
        self._key = str(uuid.uuid4())
        try:
            if report is not None and instance.state is State.RUNNING:
                self._client.renew_instance(instance.id, Renew(report=report))
            self._client.delete_instance(instance.id)
        except (ApiError, Unreachable) as error:
            _log.warning("instance %s was not released, its lease will end it: %s", instance.id, error)
            return None
        return instance.id

    def _move(self, held: Instance, request: InstanceCreate) -> float:
        """Bring an instance up elsewhere, or follow the orchestrator to one; this one is kept until that one serves.

        Whatever goes wrong with it costs nothing.
        """
        try:
            if self._next is None:
                if held.successor:
                    made = self._client.get_instance(held.successor)
                else:
                    made = self._client.create_instance(request, idempotency_key=str(uuid.uuid4()))
                self._next = (made, self._clock())
                return _POLL_S
            (coming, began) = self._next
            found = self._with_key(self._client.renew_instance(coming.id, Renew()))
        except (ApiError, Unreachable, _KeyTakenError) as error:
            return self._stay(held, str(error))
        self._next = (found, began)
        if found.state.final or found.state is State.STOPPING or self._clock() - began > _MOVE_S:
            return self._stay(held, found.reason or f"it is {found.state}, and does not serve")
        if found.state is State.RUNNING:
            self._events.append(InstanceReported(found))
        return _poll(_MOVING_S, self._clock() - began)

    def _take_over(self, serving: str | None) -> None:
        """Let the one before go, once another one serves."""
        if self._next is not None and self._next[0].state is State.RUNNING and self._next[0].id == serving:
            held, self._instance = self._instance, self._next[0]
            self._next = None
            self._let_go(held)

    def _stay(self, held: Instance, reason: str) -> float:
        if self._next is not None:
            self._let_go(self._next[0])
            self._next = None
        _log.warning("instance %s is kept, there is none elsewhere: %s", held.id, reason)
        self._events.append(MoveFailed(held, reason))
        return self._renew_s

    def _exchange(self, request: InstanceCreate) -> Instance:
        now = self._clock()
        if self._instance is None:
            self._renewed_at = self._asked_at = now
            return self._client.create_instance(request, idempotency_key=self._key)
        running = self._instance.state is State.RUNNING
        if running:
            self._asked_at = now  # should it have to be started again, that begins now
        # One that comes up holds its lease too: an image may take minutes to be there, and room longer.
        if running or now - self._renewed_at >= self._renew_s:
            self._renewed_at = now
            return self._client.renew_instance(self._instance.id, Renew(report=self._report() if running else None))
        return self._client.get_instance(self._instance.id)

    def _with_key(self, instance: Instance) -> Instance:
        """The same with its session's key, which is asked for once.

        Raises:
            _KeyTakenError: Somebody else has it.
        """
        session = instance.session
        if session is None or session.key is not None or instance.state.final or instance.state is State.STOPPING:
            return instance
        key = self._keys.get(instance.id)
        if key is None:
            try:
                key = self._client.claim_session(instance.id, self._claim)
            except ApiError as error:
                if error.problem.status == 409:
                    raise _KeyTakenError(instance, str(error)) from error
                raise
            held = [one.id for one in (self._instance, self._next[0] if self._next else None) if one is not None]
            self._keys = {one: known for one, known in self._keys.items() if one in held} | {instance.id: key}
        return instance.model_copy(update={"session": session.model_copy(update={"key": key})})

    def _refused(self, error: ApiError, service: str) -> float:
        """The orchestrator answered, but not with an instance."""
        status = error.problem.status
        if status == 404 and self._instance is not None:
            return self._lost(f"instance {self._instance.id} is gone; asking for {service} again")
        if status == 403 or (status == 401 and not self._another_token()):
            return self._set_trouble(str(error), _REFUSED_S)
        return self._set_trouble(str(error), self._backoff.next())

    def _lost(self, sentence: str) -> float:
        """The instance has ended; one that is coming is followed, otherwise another is asked for."""
        self._instance, self._next = (self._next[0] if self._next else None), None
        self._key = str(uuid.uuid4())
        return self._set_trouble(sentence, self._backoff.next())

    def _set_trouble(self, sentence: str, delay: float) -> float:
        self._trouble = sentence[:_LONGEST]
        return delay


def _elsewhere(before: Instance | None, now: Instance, wanted: str | None) -> bool:
    """Whether an instance runs where it is not wanted; where it was moved just now, the robot has not seen that yet."""
    if wanted is None or before is None or before.placement is None or now.placement is None:
        return False
    return before.placement.site == now.placement.site != wanted


def _poll(first_s: float, since_s: float) -> float:
    """Seconds until the next look at what was asked for so long ago."""
    return min(_POLL_MOST_S, max(first_s, _POLL_SHARE * since_s))
