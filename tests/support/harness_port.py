"""A service in made-up time whose actions a real bridge carries: for clients that are programs of ROS."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

from skytether.api.manifest import TopicSpec
from skytether.bridge import Bridge, CallError, SessionSpec
from skytether.bridge.spec import topics_from_api
from skytether.service.errors import CallError as Refused
from skytether.testing.service import Harness
from skytether.wire.events import Event, MessageReceived
from skytether.wire.topic import Role, Topic

KEY = bytes(32)


class HarnessPort:
    """The service's end: hands on all that the robot says, and what actions answer."""

    def __init__(self, harness: Harness[Any]) -> None:
        self._harness = harness
        self._carried = [name for name in harness.service.senders if "/" in name]
        self._calls = [name for name in harness.service.answers if "/_action/" in name]

    def attach(self, publisher: Any) -> None:
        heard = self._harness.receive

        def receive(topic: str, payload: bytes | memoryview) -> None:
            heard(topic, payload)
            if topic in self._carried:
                publisher.publish(topic, payload)

        self._harness.receive = receive  # type: ignore[method-assign]
        for name in self._calls:
            publisher.answer(name, partial(self._answer, name))

    def deliver(self, message: MessageReceived) -> None:
        self._harness.port.deliver(message)

    def notify(self, event: Event) -> None:
        pass

    def _answer(self, name: str, request: bytes) -> bytes:
        try:
            return self._harness.port.desk.ask(name, request, self._harness.encoding).result()
        except Refused as error:
            raise CallError(str(error)) from error


@contextmanager
def carried(
    harness: Harness[Any], specs: Sequence[TopicSpec], open_robot: Callable[[], tuple[Sequence[Topic], Any]]
) -> Iterator[None]:
    """A session between the harness's service and a robot that is a graph.

    Args:
        harness: Its service.
        specs: The service's rows.
        open_robot: Gives the robot's table and port.
    """
    topics = topics_from_api(specs)
    with Bridge(SessionSpec(7, KEY, Role.SERVICE, topics), HarnessPort(harness)) as service:
        table, port = open_robot()
        with Bridge(SessionSpec(7, KEY, Role.ROBOT, tuple(table)), port, peer=service.address):
            yield
