"""One robot of a simulated fleet: the agent's side of REST and its sums, sessions over a made-up link."""

from __future__ import annotations

import os
import time
import uuid
import zlib
from collections import Counter
from typing import Any

from skytether.api.client import Client, Unreachable
from skytether.api.rest import Instance, InstanceCreate, Renew, Report, State
from skytether.bridge.spec import SessionSpec
from skytether.emulator.link_model import LinkConditions
from skytether.emulator.lossy_link import LossyLink
from skytether.robot.agent.snapshot import report
from skytether.robot.offload.lease_client import InstanceReported, LeaseClient, Wanted
from skytether.robot.session.counter_totals import COUNTERS, CounterTotals
from skytether.wire import Direction, Role, Session

from .requests import sleeper
from .traffic import TABLE4, Flow

LEASE_S = 300.0
"""Longer than a robot of a large fleet waits for its turn."""
_DRAIN_S = 3.0
"""Made-up seconds for what is under way when a session is let go."""
MANIFEST = sleeper(
    [
        {
            "name": flow.name,
            "type": "lab_msgs/msg/Bytes",
            "direction": flow.direction.value,
            "priority": 128 - flow.rank,
            "depth": flow.depth,
            "lifespan_ms": flow.lifespan * 1e3,
            "delivery": flow.delivery,
            "period_ms": 1e3 / flow.hz,
        }
        for flow in TABLE4
    ]
)
"""With the topics of Table 4."""

Series = Counter[tuple[str, ...]]
"""Messages (or bytes) by robot, topic, direction and outcome."""


class SimulatedRobot:
    """A robot that wants the service always; its time passes when ``run`` is called.

    Attributes:
        number: Which one.
        name: As the orchestrator knows it.
        answers: How long each renewal took, seconds.
    """

    def __init__(self, number: int, client: Client, request: InstanceCreate, *, odd: bool) -> None:
        """``odd``: requests come twice and late, and answers are lost."""
        self.number = number
        self.name = request.robot
        self.answers: list[float] = []
        self._client = _Timed(client, self.answers, odd=odd)
        self._request = request
        self._now = 0.0
        self._given: Counter[tuple[str, str]] = Counter()
        """What the graphs at both ends were given, by topic and direction."""
        self._killed = False
        self._before: Series = Counter()
        """What programs of the robot that were killed had told."""
        self._begin()

    def _begin(self) -> None:
        self._links: dict[str, LossyLink] = {}
        self._instances: dict[str, str] = {}
        """Whose session each is."""
        self._instance: Instance | None = None
        self._totals = CounterTotals(uuid.uuid4().hex)
        self._lease_client = LeaseClient(self._client, report=self._report)

    @property
    def instance(self) -> Instance:
        """What was heard of it last."""
        if self._instance is None:
            raise Unreachable(f"{self.name} has no instance yet")
        return self._instance

    @property
    def trouble(self) -> str:
        """Why it is not served."""
        return self._lease_client.trouble

    @property
    def settled(self) -> bool:
        """One instance runs, its session is up, and nothing is on the move."""
        one = self._instance
        return (
            one is not None
            and one.session is not None
            and one.state is State.RUNNING
            and not one.successor
            and not self._lease_client.trouble
            and list(self._links) == [one.session.id]
            and self._links[one.session.id].sessions[Role.ROBOT].stats(self._now).connected
        )

    def run(self, seconds: float, *, traffic: bool) -> None:
        """Let time pass on all its sessions."""
        for link in self._links.values():
            self._run(link, self._now + seconds, traffic=traffic)
        self._now += seconds

    def exchange(self) -> None:
        """One exchange with the orchestrator, and what follows from it."""
        self._lease_client.step(Wanted(self._request, serving=self._serving()))
        while (event := self._lease_client.next_event()) is not None:
            if isinstance(event, InstanceReported):
                self._follow(event.instance)

    def begin_anew(self) -> None:
        """Its program is killed just after a report, and started."""
        self.run(_DRAIN_S, traffic=False)
        self.exchange()
        self._before.update(self.counted())
        self._killed = True
        self._begin()

    def service_restarted(self) -> None:
        """The process of its service was killed and started: another end of the same session."""
        self._killed = True
        link = self._links[_session(self.instance).id]
        link.replace(Role.SERVICE, self._end(Role.SERVICE, self.instance))

    def leave(self) -> None:
        """Let the service go."""
        for session in list(self._links):
            self._close(session)
        self._lease_client.release()
        self._instance = None

    def come_back(self) -> None:
        """Ask for it again."""
        self.exchange()

    def counted(self) -> Series:
        """What it counted in all its life, also what an earlier program had told."""
        counted: Series = Counter(self._before)
        for key, (_, counts) in self._totals.sums().items():
            for name in COUNTERS:
                counted[(self.name, *key, name)] += counts[name]
        return counted

    def unexplained(self) -> int:
        """Messages that were sent and of which nothing is known."""
        total = 0
        for _, counts in self._totals.sums().values():
            ended = counts["delivered"] + counts["superseded"] + counts["lost"] - counts["late"] + counts["unknown"]
            total += abs(counts["sent"] - ended)
        return total

    def miscounted(self, exported: Series) -> int:
        """Messages by which what is exported as delivered differs from what the graphs were given."""
        if self._killed:
            return 0
        return sum(abs(exported[(self.name, *key, "delivered")] - given) for key, given in self._given.items())

    def _report(self) -> Report:
        for link in self._links.values():
            self._totals.update(link, link.sessions[Role.ROBOT].stats(self._now))
        return report(None, self._totals, None, 0.1)

    def _follow(self, instance: Instance) -> None:
        self._instance = instance
        session = instance.session
        if instance.state is not State.RUNNING or session is None or session.id in self._links:
            return
        seed = zlib.crc32(f"{self.name} {len(self._links)} {self._now}".encode())
        bad = LinkConditions(delay=0.05, jitter=0.01, loss=0.03, seed=seed)
        ends = (self._end(Role.ROBOT, instance), self._end(Role.SERVICE, instance))
        self._links[session.id] = LossyLink(*ends, up=bad, down=bad, seed=seed, start=self._now)
        self._instances[session.id] = instance.id

    def _serving(self) -> str | None:
        """Id of the instance of the newest session, once that is up; those before it are closed then."""
        newest = next(reversed(self._links), None)
        if newest is None or not self._links[newest].sessions[Role.ROBOT].stats(self._now).connected:
            return None
        for other in [known for known in self._links if known != newest]:
            self._close(other)
        return self._instances[newest]

    def _close(self, session: str) -> None:
        """Hear what was under way, and let the session go."""
        link = self._links.pop(session)
        del self._instances[session]
        self._run(link, self._now + _DRAIN_S, traffic=False)
        self._totals.update(link, link.sessions[Role.ROBOT].stats(link.now), last=True)

    def _end(self, role: Role, instance: Instance) -> Session:
        session = _session(instance)
        spec = SessionSpec.from_api(role, session.id, session.key, session.topics)
        return Session(role, spec.id, spec.key, spec.topics, entropy=os.urandom, now=self._now)

    def _run(self, link: LossyLink, until: float, *, traffic: bool) -> None:
        for flow in TABLE4 if traffic else ():
            self._plan(link, flow, until)
        link.run_until(until)
        for role, messages in link.messages.items():
            direction = Direction.OUT if role is Role.ROBOT else Direction.IN
            self._given.update((message.topic, direction.value) for _, message in messages)
            messages.clear()

    def _plan(self, link: LossyLink, flow: Flow, until: float) -> None:
        """Publish at the multiples of the period."""
        sender = Role.ROBOT if flow.direction is Direction.IN else Role.SERVICE
        due = int(link.now * flow.hz) + 1
        while due / flow.hz < until:
            link.at(due / flow.hz, lambda: link.publish(sender, flow.name, bytes(flow.size)))
            due += 1


class _Timed:
    """A client whose renewals are timed; an odd one loses answers, and sends requests twice and out of order."""

    def __init__(self, client: Client, answers: list[float], *, odd: bool) -> None:
        self.create_instance = client.create_instance
        self.get_instance = client.get_instance
        self.claim_session = client.claim_session
        self.delete_instance = client.delete_instance
        self._client = client
        self._answers = answers
        self._odd = odd
        self._last: Renew | None = None

    def renew_instance(self, instance_id: str, renew: Renew) -> Instance:
        began = time.monotonic()
        answer = self._client.renew_instance(instance_id, renew)
        self._answers.append(time.monotonic() - began)
        if self._odd:
            self._client.renew_instance(instance_id, renew)
            if self._last is not None:
                self._client.renew_instance(instance_id, self._last)
            self._last = renew
            if len(self._answers) % 3 == 0:
                raise Unreachable("the answer was lost")
        return answer


def _session(instance: Instance) -> Any:
    if instance.session is None:
        raise Unreachable(f"instance {instance.id} came without its session")
    return instance.session
