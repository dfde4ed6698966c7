"""The robot's side of REST: asks for a service, keeps the lease, notices what changed. Never in the way of driving.

The orchestrator may be away, come back, lose the instance, or refuse the token: each is said once, the asking goes on
with back-off, and a bridge that is up is left alone. `Asker.step` is one exchange and says when the next is due; `run`
is the loop for a thread.
"""

from __future__ import annotations

import logging
import threading
import uuid
from collections.abc import Callable
from random import Random
from typing import Protocol

from skytether.api.client import ApiError, Unreachable
from skytether.api.rest import Instance, InstanceCreate, Renew, Report, State

from .backoff import Backoff

_log = logging.getLogger(__name__)

_POLL_S = 0.03
"""Between looks at an instance that is coming up; a start takes some hundred milliseconds."""
_LOOK_S = 0.2
"""Until the first look when the link went bad: the service may have come back at another address."""
_REFUSED_S = 10.0
"""Before a refused token is tried again: an operator has to act."""


class Orchestrator(Protocol):
    """What the asker needs of `skytether.api.client.Client`; every call raises ApiError or Unreachable."""

    def create_instance(self, request: InstanceCreate, *, idempotency_key: str) -> Instance:
        """Ask for a service; the same key gives the same instance."""
        ...

    def get_instance(self, instance_id: str) -> Instance:
        """Look."""
        ...

    def renew_instance(self, instance_id: str, renew: Renew) -> Instance:
        """Keep the lease and report."""
        ...

    def delete_instance(self, instance_id: str) -> object:
        """Let go."""
        ...


class Asker:
    """Wants one instance of a service to run, for as long as it is asked to.

    Args:
        client: The orchestrator.
        request: What is wanted.
        on_instance: Told every answer about an instance that is coming up or running.
        report: What to say with each renewal.
        healthy: Whether the link is good; while it is not, the address is looked at more often.
        renew_s: Time between renewals [s].
        random: For the jitter of the back-off.
    """

    def __init__(
        self,
        client: Orchestrator,
        request: InstanceCreate,
        *,
        on_instance: Callable[[Instance], None],
        report: Callable[[], Report | None] = lambda: None,
        healthy: Callable[[], bool] = lambda: True,
        renew_s: float = 2.0,
        random: Random | None = None,
    ) -> None:
        self._client = client
        self._request = request
        self._on_instance = on_instance
        self._report = report
        self._healthy = healthy
        self._renew_s = renew_s
        random = random or Random()
        self._backoff = Backoff(0.2, 5.0, random)
        self._looks = Backoff(min(_LOOK_S, renew_s), renew_s, random)
        self._key = str(uuid.uuid4())
        self._instance: Instance | None = None
        self._trouble = ""

    @property
    def trouble(self) -> str:
        """What stands in the way now, in one sentence; empty while all is well."""
        return self._trouble

    def step(self) -> float:
        """One exchange with the orchestrator.

        Returns:
            Seconds until the next is due.
        """
        try:
            instance = self._exchange()
        except Unreachable as error:
            return self._say(str(error), self._backoff.next())
        except ApiError as error:
            if error.problem.status == 404 and self._instance is not None:
                return self._lost(f"instance {self._instance.id} is gone; asking for {self._request.service} again")
            if error.problem.status in (401, 403):
                return self._say(str(error), _REFUSED_S)
            return self._say(str(error), self._backoff.next())
        if instance.state.final or instance.state is State.STOPPING:
            reason = f": {instance.reason}" if instance.reason else ""
            return self._lost(f"instance {instance.id} is {instance.state}{reason}")
        self._instance = instance
        self._on_instance(instance)
        if instance.state is not State.RUNNING:
            return _POLL_S
        self._backoff.reset()
        self._trouble = ""
        if not self._healthy():
            return self._looks.next()
        self._looks.reset()
        return self._renew_s

    def run(self, stop: threading.Event) -> None:
        """Exchange until told to stop; trouble is logged, each once."""
        delay = 0.0
        told = ""
        while not stop.wait(delay):
            try:
                delay = self.step()
            except Exception as error:  # a robot must not stop asking because of one strange answer
                _log.debug("asking failed", exc_info=error)
                delay = self._say(f"asking failed unexpectedly: {error!r}", self._backoff.next())
            if self._trouble and self._trouble != told:
                _log.warning("%s", self._trouble)
            told = self._trouble

    def release(self) -> str | None:
        """Let the instance go; an orchestrator that does not answer frees it when the lease ends.

        Returns:
            The instance's id, if there was one and the orchestrator took it back.
        """
        if self._instance is None:
            return None
        released, self._instance = self._instance.id, None
        try:
            self._client.delete_instance(released)
        except (ApiError, Unreachable) as error:
            _log.warning("instance %s was not released, its lease will end it: %s", released, error)
            return None
        return released

    def _exchange(self) -> Instance:
        if self._instance is None:
            return self._client.create_instance(self._request, idempotency_key=self._key)
        if self._instance.state is State.RUNNING:
            return self._client.renew_instance(self._instance.id, Renew(report=self._report()))
        return self._client.get_instance(self._instance.id)

    def _lost(self, sentence: str) -> float:
        self._instance = None
        self._key = str(uuid.uuid4())
        return self._say(sentence, self._backoff.next())

    def _say(self, sentence: str, delay: float) -> float:
        self._trouble = sentence
        return delay
