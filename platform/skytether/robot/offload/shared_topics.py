"""Carries what the robot's service shares to the orchestrator, and what the group's other robots share to the service.

The agent reads none of it. Whether there is a group, and who is in it, the orchestrator says; without one the service
hears nothing, so it says nothing either.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

from skytether.api.client import ApiError, Unreachable
from skytether.api.manifest import TopicSpec
from skytether.api.rest import MOST_NEIGHBOURS, Neighbours, Share, unshareable
from skytether.messages import DecodeError, Message, String, decode

from ..log_throttle import LogThrottle
from ..session.session import LiveSession

_log = logging.getLogger(__name__)

PERIOD_S = 1.0
"""Between two exchanges: what one robot's service says, another's hears after two of them at most, and the ways."""
ALONE_S = 10.0
"""Between looks whether the robot is in a group by now; and after an exchange that failed."""
_REFUSED = 401


class Exchanges(Protocol):
    """What this needs of `skytether.api.client.Client`."""

    def share(self, instance_id: str, share: Share) -> Neighbours:
        """Tell, and hear; raises ApiError or Unreachable."""
        ...


@dataclass(frozen=True, slots=True)
class SharedTopics:
    """The topics of a service that go to other robots.

    Attributes:
        said: What it tells; None: nothing.
        heard: On which it hears the others; None: it does not.
    """

    said: str | None = None
    heard: str | None = None

    @classmethod
    def of(cls, specs: Iterable[TopicSpec]) -> SharedTopics:
        """Of a service's topics; of a manifest that has several, which an orchestrator refuses, the last."""
        shared = {spec.direction: spec.name for spec in specs if spec.shared}
        return cls(shared.get("out"), shared.get("in"))

    @property
    def readings(self) -> dict[str, type[Message]]:
        """What the robot's end of the bridge sends of them."""
        return {} if self.heard is None else {self.heard: String}


@dataclass(frozen=True, slots=True)
class Serving:
    """The session that serves the robot now, its instance, and what of it is shared."""

    session: LiveSession
    instance: str
    topics: SharedTopics


class SharedTopicsExchange:
    """Exchanges again and again. For a thread of its own.

    Args:
        client: The orchestrator.
        serving: What serves the robot now.
        on_refused: Called when the token was refused; what it gives does not matter, the next time is soon.
        clock: Monotonic seconds, the bridge's.
    """

    def __init__(
        self,
        client: Exchanges,
        serving: Callable[[], Serving | None],
        *,
        on_refused: Callable[[], object] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._client = client
        self._serving = serving
        self._on_refused = on_refused
        self._clock = clock
        self._log_throttle = LogThrottle(_log)
        self._with: str = ""
        """The session that was shared with last."""
        self._due = 0.0

    def step(self) -> None:
        """Exchange once, if it is time to."""
        serving, now = self._serving(), self._clock()
        if serving is None or serving.topics == SharedTopics() or not serving.session.connected:
            return
        if serving.session.id == self._with and now < self._due:
            return
        self._with, self._due = serving.session.id, now + ALONE_S
        try:
            found = self._client.share(serving.instance, self._said(serving.session, now))
        except (ApiError, Unreachable) as error:
            self._log_throttle.warn("shared", f"nothing is shared with other robots: {error}", now)
            if isinstance(error, ApiError) and error.problem.status == _REFUSED:
                self._on_refused()
            return
        if found.group is None:
            return
        self._due = now + PERIOD_S / 2  # a little early is better than a whole period late
        if serving.topics.heard is not None:
            others = [one.model_dump() for one in found.others[:MOST_NEIGHBOURS] if unshareable(one.text) is None]
            # As it is: escapes would make what one says twelve times as long, and the others' have no room.
            serving.session.publish(serving.topics.heard, String(json.dumps(others, ensure_ascii=False)))

    def run(self, ended: threading.Event) -> None:
        """Exchange until told to end."""
        while not ended.wait(PERIOD_S):
            try:
                self.step()
            except Exception as error:  # one strange answer must not be the last one
                self._log_throttle.warn(
                    "strange", f"nothing could be shared with other robots: {error!r}", self._clock()
                )

    def _said(self, session: LiveSession, now: float) -> Share:
        """What the service said since the last time. What is no text, or too long, is named and left out."""
        message, session.said = session.said, None
        if message is None:
            return Share()
        try:
            text = decode(String, message.payload, session.encoding).data
        except DecodeError as error:
            self._log_throttle.warn("decode", f"what the service shares is left out: {error}", now)
            return Share()
        if why := unshareable(text):
            self._log_throttle.warn("unshareable", f"what the service shares is left out: {why}", now)
            return Share()
        return Share(text=text, age_s=min(max(0.0, now - message.received_at), 3600.0))
