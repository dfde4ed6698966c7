"""The robots of the benchmark of starts: for each service that it can start, the one that asks for it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from skytether.lab.bench.pair import BenchError
from skytether.lab.demo import WalkerHardware
from skytether.lab.trail import Trail
from skytether.lab.walk import World
from skytether.lab.world.agent import Clockwork, WorldGraph, WorldHardware
from skytether.lab.world.model import WorldError
from skytether.lab.world.occupancy import Occupancy
from skytether.lab.world.plan import building
from skytether.lab.world.simulation import Simulation
from skytether.messages import String, decode
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig
from skytether.robot.control.command import Command
from skytether.robot.control.supervisor import Objection


@dataclass(slots=True)
class Watch:
    """Notes when the robot was first told to move, as an observer of its agent.

    Attributes:
        moved_at: Arrival of the first command that moves it and was accepted [s of the robot's clock].
    """

    moved_at: float | None = None

    def __call__(self, command: Command, objection: Objection | None) -> None:
        if self.moved_at is None and objection is None and (command.linear or command.angular):
            self.moved_at = command.received_at


@dataclass(frozen=True)
class Asking:
    """What asks for a service.

    Attributes:
        params: Of the service; the same at each start, so that a standby fits.
        agent: Makes the agent of a new robot with this configuration and watch; it is not started.
        moves: Whether the service moves it: a walker that nobody pushes stands.
    """

    agent: Callable[[AgentConfig, Watch], Agent]
    params: Mapping[str, Any] = field(default_factory=dict)
    moves: bool = False


def _walker() -> Asking:
    return Asking(lambda config, watch: Agent(config, WalkerHardware(World(Trail(), seed=1)), observer=watch))


def _wheels() -> Asking:
    """A robot in the simulated building that has its map and is to go to the first goal."""
    plan = building()
    start, goal = plan.starts[0], plan.goals[0]
    map_ = Occupancy(plan).message()

    def agent(config: AgentConfig, watch: Watch) -> Agent:
        graph = WorldGraph()

        def give_map(payload: bytes | memoryview) -> None:
            if json.loads(decode(String, payload, "cdr").data)["code"] == "no_map":
                graph.publish("map", map_)

        graph.subscribe("status", give_map)
        try:
            world = Simulation(plan, seed=1)
        except WorldError as error:
            raise BenchError(str(error)) from error
        return Agent(config, WorldHardware(Clockwork(world), graph=graph), graph=graph, observer=watch)

    params = {
        "start": {"x": start.x, "y": start.y, "yaw": start.heading},
        "goals": [{"x": goal.x, "y": goal.y, "yaw": goal.heading}],
    }
    return Asking(agent, params, moves=True)


ROBOTS: Mapping[str, Callable[[], Asking]] = MappingProxyType({"virtual-trail": _walker, "navigation": _wheels})
"""By service."""
