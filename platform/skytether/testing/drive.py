"""A service that drives a robot, in the simulated world, without processes and with made-up time: its closed loop.

Between robot and service lies a link, one model of it for each direction. The clocks of both agree.
"""

from __future__ import annotations

import heapq
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

from skytether.emulator.link_model import LinkConditions, LinkModel
from skytether.lab.world.occupancy import Occupancy
from skytether.lab.world.plan import Plan
from skytether.lab.world.simulation import TICK, Robot, Simulation
from skytether.messages import Encoding, Message
from skytether.service import Service

from .service import Harness

Alter = Callable[[str, Message], Message | None]
"""What becomes of a message of the robot; None: it is lost."""

_SENSORS = ("tf", "odom", "scan")
_PACKET = 100
"""Bytes of each message to the link's model, which has no limit of rate here."""


class StepTime(NamedTuple):
    """What one step of the service took, with decoding what came and encoding what it says.

    Attributes:
        wall: By the clock [s].
        cpu: Of its thread [s].
    """

    wall: float
    cpu: float


class Drive:
    """One robot, one service, and a link between them.

    Attributes:
        world: The building.
        harness: The service.
        alter: Changes what the robot's sensors say.
        statuses: All that the service told of itself, as the pairs (state, code), each once when it changed.
        times: Of each step.
        acted: When each command that arrived so far was sent, and when it arrived [s].
    """

    def __init__(
        self,
        service: type[Service[Any]],
        folder: Path,
        params: Mapping[str, Any],
        plan: Plan,
        *,
        seed: int = 1,
        link: LinkConditions | None = None,
        encoding: Encoding = "cdr",
    ) -> None:
        """Put the robot at the plan's first start, and tell the service.

        Args:
            service: It takes the parameters ``map`` and ``start``, and tells its ``state`` and ``code`` on ``status``.
            folder: The plan's map is written there.
            params: More parameters; they go before those two.
            plan: With all that stands there.
            seed: Of the world's noise.
            link: Each way of it; None: nothing is delayed.
            encoding: What the robot speaks.
        """
        Occupancy(plan).save(folder / "map")
        self.world = Simulation(plan, seed=seed)
        start = plan.starts[0]
        known = {"start": {"x": start.x, "y": start.y, "yaw": start.heading}}
        self.harness = Harness(service, {"map": "map.yaml", **known, **params}, data_dir=folder, encoding=encoding)
        self.alter: Alter = lambda _, message: message
        self.statuses: list[tuple[str, str]] = []
        self.times: list[StepTime] = []
        self.acted: list[tuple[float, float]] = []
        conditions = link or LinkConditions()
        self._up = _Way(conditions, "up")
        self._down = _Way(replace(conditions, seed=conditions.seed + 1), "down")
        self._period = 1 / (self.harness.service.rate_hz or 30.0)
        self._due = self.harness.now
        self._read = 0

    @property
    def robot(self) -> Robot:
        """The simulated robot."""
        return self.world.robots[0]

    @property
    def status(self) -> dict[str, Any]:
        """The newest that the service told."""
        newest = self.harness.newest("status")
        return dict(json.loads(newest.data)) if newest is not None else {}

    @property
    def state(self) -> str:
        """The newest that it told of its state; empty: nothing yet."""
        return self.statuses[-1][0] if self.statuses else ""

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Go on for so long; returns at once, and true, when ``until`` does."""
        for _ in range(round(seconds / TICK)):
            self._tick()
            if until():
                return True
        return False

    def until(self, state: str, seconds: float, code: str | None = None) -> bool:
        """Go on until the service tells this state."""
        return self.run(seconds, lambda: self.state == state and code in (None, self.statuses[-1][1]))

    def _tick(self) -> None:
        harness = self.harness
        harness.now += TICK
        now = harness.now
        for sent, _, command in self._down.arrived(now):
            self.acted.append((sent, now))
            self.robot.write(command)
        for topic, message in self.world.tick(now)[0]:
            altered = self.alter(topic, message) if topic in _SENSORS else None
            if altered is not None and not self._up.send(topic, altered, now):
                harness.skip(topic)
        for sent, topic, message in self._up.arrived(now):
            harness.send(topic, message, age=now - sent)
        if now + 1e-9 >= self._due:
            self._due += self._period
            wall, cpu = time.perf_counter(), time.thread_time()
            harness.step(0.0)
            self.times.append(StepTime(time.perf_counter() - wall, time.thread_time() - cpu))
            self._down.send("cmd_vel", harness.newest("cmd_vel"), now)
            self._note()

    def _note(self) -> None:
        told = self.harness.outputs["status"]
        for message in told[self._read :]:
            document = json.loads(message.data)  # type: ignore[attr-defined] # a String
            pair = (document["state"], document["code"])
            if not self.statuses or self.statuses[-1] != pair:
                self.statuses.append(pair)
        self._read = len(told)
        for topic, messages in self.harness.outputs.items():
            if topic != "status":
                del messages[:-1]


class _Way:
    """One direction. As over the bridge, a message that a newer one of its topic overtook never arrives."""

    def __init__(self, conditions: LinkConditions, direction: str) -> None:
        self._model = LinkModel(conditions, direction)
        self._under_way: list[tuple[float, int, float, str, Any]] = []
        self._newest: dict[str, float] = {}
        self._number = count()

    def send(self, topic: str, message: Message, now: float) -> bool:
        """False: it is lost."""
        times = self._model.decide(_PACKET, now)
        for when in times:
            heapq.heappush(self._under_way, (when, next(self._number), now, topic, message))
        return bool(times)

    def arrived(self, now: float) -> list[tuple[float, str, Any]]:
        """When they were sent, topic and message, in the order of arrival."""
        found = []
        while self._under_way and self._under_way[0][0] <= now + 1e-9:
            _, _, sent, topic, message = heapq.heappop(self._under_way)
            if sent > self._newest.get(topic, -1.0):
                self._newest[topic] = sent
                found.append((sent, topic, message))
        return found
