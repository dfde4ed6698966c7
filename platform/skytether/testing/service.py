"""Run a service, or only the loop around it, with made-up time: no process, no bridge, no network.

    harness = Harness(WallStop, {"distance": 0.5})
    harness.send("scan", LaserScan(ranges=[0.4]))
    harness.step()
    assert harness.newest("cmd_vel") == Twist()

Messages go through the codec and the mailboxes on both ways, as in the real process; only the bridge is left out.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

from skytether.api.manifest import TopicSpec
from skytether.bridge import CallError as BridgeCallError
from skytether.bridge.spec import topics_from_api
from skytether.messages import Encoding, Message, decode, encode
from skytether.service import Context, Service
from skytether.service.errors import CallError
from skytether.service.params import read_params
from skytether.service.port import ServicePort
from skytether.service.topics import Action, Answer, Call, Typed
from skytether.wire.events import Connected, Disconnected, MessageReceived
from skytether.wire.topic import Topic

S = TypeVar("S", bound=Service[Any])
T = TypeVar("T")


class FakeClock:
    """A clock that only moves when somebody sleeps on it, or says so; for `skytether.service.loop.Loop`.

    What was planned with `at` happens when its time comes, in order.
    """

    def __init__(self, now: float = 1000.0) -> None:
        self._now = now
        self._woken = False
        self._plan: list[tuple[float, Callable[[], None]]] = []

    def at(self, when: float, action: Callable[[], None]) -> None:
        """Plan something for a later time."""
        self._plan.append((when, action))
        self._plan.sort(key=lambda entry: entry[0])

    def now(self) -> float:
        return self._now

    def advance(self, seconds: float) -> None:
        """Let time pass while somebody computes."""
        self._pass_until(self._now + seconds)

    def sleep_until(self, deadline: float) -> None:
        while not self._woken and self._now < deadline:
            if not self._plan and deadline == math.inf:
                raise RuntimeError("this sleep would never end: nothing is planned")
            self._pass_until(min(deadline, self._plan[0][0]) if self._plan else deadline)
        self._woken = False

    def wake(self) -> None:
        self._woken = True

    def _pass_until(self, when: float) -> None:
        while self._plan and self._plan[0][0] <= when:
            self._now, action = max(self._now, self._plan[0][0]), self._plan[0][1]
            del self._plan[0]
            action()
        self._now = when


class Harness(Generic[S]):
    """One service with a robot connected, started, at time ``now``.

    Attributes:
        service: The service itself.
        now: Made-up time, s.
        outputs: By topic, every message published so far.
        port: The service's end of a bridge: a test may put a real session there.
    """

    def __init__(
        self,
        cls: type[S],
        params: Mapping[str, Any] | None = None,
        *,
        encoding: Encoding = "cdr",
        data_dir: Path | None = None,
        now: float = 1000.0,
        epoch: float = 0.0,
    ) -> None:
        """Build, connect and start it.

        Args:
            cls: The service.
            params: As a robot would give them, checked the same way.
            encoding: What the robot speaks. It has the actions of ROS 1 with ``ros1``, else those of ROS 2.
            data_dir: Where the service may write.
            now: First time, s.
            epoch: Unix time at which the made-up clock stood at 0.

        Raises:
            ConfigError: The parameters are wrong.
            ServiceError: The service refused to start.
        """
        self.now = now
        self.outputs: defaultdict[str, list[Message]] = defaultdict(list)
        self._encoding = encoding
        self._sequence: defaultdict[str, int] = defaultdict(int)
        context = Context("robot", "instance", data_dir or Path(), epoch)
        self.service = cls(read_params(cls.params_type, params or {}), context)
        self._types = {name: sender.type_name for name, sender in self.service.senders.items()}
        self._robots: dict[str, Callable[[Any], Message]] = {}
        self.port = ServicePort(self.service, lambda: None, _at_once)
        self.port.attach(_Robot(self))
        self.connect()
        self.service.start()

    @property
    def encoding(self) -> Encoding:
        """What the robot speaks."""
        return self._encoding

    def connect(self, *extra: Topic) -> None:
        """The robot is there; ``extra``: topics that only an `AnyInput` takes."""
        declared = [d for d in self.service.declared if isinstance(d, Typed)]
        typed = [Topic(d.topic, d.type_name, d.direction, encoding=self._encoding) for d in declared]
        calls = [d for d in self.service.declared if isinstance(d, Call | Answer)]
        asked = [Topic(f"{d.topic}/request", d.type_name, d.direction, encoding=self._encoding) for d in calls]
        kind: Literal["action", "ros2_action"] = "action" if self._encoding == "ros1" else "ros2_action"
        served = [d for d in self.service.declared if isinstance(d, Action) and d.kind == kind]
        rows = [TopicSpec(name=d.topic, kind=kind, type=d.type_name, direction="in") for d in served]
        parts = [replace(topic, encoding=self._encoding) for topic in topics_from_api(rows)]
        self.port.notify(Connected((*typed, *asked, *parts, *extra)))

    def disconnect(self) -> None:
        """The robot is gone."""
        self.port.notify(Disconnected("silent"))

    def send(self, topic: str, message: Message | bytes, *, age: float = 0.0, clock_error: float = 0.0) -> None:
        """A message arrives now, published ``age`` seconds ago; bytes arrive as they are.

        The robot's clock is known to within ``clock_error`` [s]; inf: it is not known yet.
        """
        payload = message if isinstance(message, bytes) else encode(message, self._encoding)
        sequence = self._sequence[topic]
        self._sequence[topic] += 1
        self.port.deliver(MessageReceived(topic, payload, sequence, self.now - age, clock_error, self.now))

    def skip(self, topic: str) -> None:
        """The link loses the topic's next message."""
        self._sequence[topic] += 1

    def call(self, name: str, request: Message) -> Any:
        """The robot calls the service.

        Raises:
            CallError: The service does not answer; the text says why.
        """
        return self.ask(name, request).result(timeout=0)

    def ask(self, name: str, request: Message) -> Future[Any]:
        """The robot calls the service, which may answer in a later step, as with an action's result."""
        answer: Future[Any] = Future()
        srv, _ = self.service.answers[name]

        def on_answer(raw: Future[bytes]) -> None:
            error = raw.exception()
            if error is not None:
                answer.set_exception(error)
            else:
                answer.set_result(decode(srv.response, raw.result(), self._encoding))

        asked = self.port.desk.ask(name, encode(request, self._encoding), self._encoding)
        asked.add_done_callback(on_answer)
        self.port.settle(self.now)
        self.port.desk.work()
        return answer

    def answers(self, name: str, robot: Callable[[Any], Message]) -> None:
        """From now on the robot answers a call of the service by a function: request in, response out.

        It raises `skytether.service.CallError` to refuse.
        """
        self._robots[name] = robot

    def step(self, elapsed: float | None = None) -> None:
        """Let time pass (one period of the rate; nothing for a service with a trigger), then step once."""
        rate = self.service.rate_hz
        self.now += elapsed if elapsed is not None else 1 / rate if rate else 0.0
        self.port.settle(self.now)
        self.port.desk.work()
        self.service.step(self.now)

    def newest(self, topic: str) -> Any:
        """The last message published on a topic, or None."""
        return self.outputs[topic][-1] if self.outputs[topic] else None

    def stop(self) -> None:
        """As at the end of the process."""
        self.service.stop()

    def receive(self, topic: str, payload: bytes | memoryview) -> None:
        """The robot gets a message."""
        self.outputs[topic].append(decode(self._types[topic], payload, self._encoding))

    def asked(self, name: str, payload: bytes | memoryview) -> bytes:
        """The robot gets a call, and answers it at once.

        Raises:
            CallError: It does not.
        """
        if name not in self._robots:
            raise CallError(f"call '{name}': this robot answers none; say how with Harness.answers")
        request = decode(self.service.callers[name].srv.request, payload, self._encoding)
        return encode(self._robots[name](request), self._encoding)


class _Robot:
    """What the service sees of a harness: the bridge's part."""

    def __init__(self, harness: Harness[Any]) -> None:
        self._harness = harness

    def publish(self, topic: str, payload: bytes | memoryview) -> bool:
        self._harness.receive(topic, payload)
        return True

    def count_dropped(self, topic: str, count: int) -> None:
        """What a service publishes comes here at once."""

    def call(self, name: str, payload: bytes | memoryview, timeout: float) -> bytes:  # noqa: ARG002 - made-up time
        try:
            return self._harness.asked(name, payload)
        except CallError as error:
            raise BridgeCallError(str(error)) from error

    def answer(self, name: str, handler: Callable[[bytes], bytes]) -> None:
        """The harness hands its calls to the service's desk."""


def _at_once(work: Callable[[], T]) -> Future[T]:
    """Instead of threads."""
    done: Future[T] = Future()
    try:
        done.set_result(work())
    except Exception as error:
        done.set_exception(error)
    return done
