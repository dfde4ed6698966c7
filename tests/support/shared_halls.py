"""Two robots in the two halls, in real time: an orchestrator process, and services wherever its sites run them."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np
from numpy.typing import NDArray
from two_halls import DOOR, HALLS, NEEDY, SCOUT

from skytether.api.client import Client
from skytether.api.rest import RobotCreate
from skytether.lab.embedded import EmbeddedOrchestrator
from skytether.lab.world.agent import Clockwork, WorldGraph, WorldHardware
from skytether.lab.world.occupancy import Occupancy
from skytether.lab.world.simulation import Simulation
from skytether.messages import Header, OccupancyGrid, Path, Point, PoseStamped, String, decode
from skytether.messages import Pose as PoseMessage
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig

PATIENCE_S = 120.0


class Robot:
    """One of them: its graph, and what its service said."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.graph = WorldGraph()
        self.status: dict[str, Any] = {}
        self.way: NDArray[np.float64] = np.empty((0, 2))
        self.costmap: OccupancyGrid | None = None
        self.leaked: list[object] = []
        self.graph.subscribe("status", self._hear_status)
        self.graph.subscribe("plan", self._hear_plan)
        self.graph.subscribe("global_costmap", self._hear_costmap)
        for topic in ("obstacles_seen", "obstacles_shared"):
            self.graph.subscribe(topic, self.leaked.append)

    def _hear_status(self, payload: bytes | memoryview) -> None:
        self.status = json.loads(decode(String, payload, "cdr").data)
        if self.status["code"] == "no_map":
            self.graph.publish("map", Occupancy(HALLS).message())

    def _hear_plan(self, payload: bytes | memoryview) -> None:
        poses = decode(Path, payload, "cdr").poses
        self.way = np.array([(p.pose.position.x, p.pose.position.y) for p in poses])

    def _hear_costmap(self, payload: bytes | memoryview) -> None:
        self.costmap = decode(OccupancyGrid, payload, "cdr")

    def cost(self, x: float, y: float) -> int:
        """In its planner's costmap; -1: unknown, or there is none yet."""
        if self.costmap is None:
            return -1
        info = self.costmap.info
        column = int((x - info.origin.position.x) / info.resolution)
        row = int((y - info.origin.position.y) / info.resolution)
        return int(self.costmap.data[row * info.width + column])

    def go(self, x: float, y: float) -> None:
        self.graph.publish("goal", PoseStamped(Header(frame_id="map"), PoseMessage(Point(x, y))))


def until(what: Callable[[], bool], robots: list[Robot]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < end, [robot.status for robot in robots]
        time.sleep(0.1)


def share(set_up: Callable[[Client], object] = lambda _: None, look: Callable[[], object] = lambda: None) -> None:
    """One sees the crate, the other goes round it once both are in one group, and not before.

    Args:
        set_up: Tells the orchestrator of other sites than its own.
        look: Called while both share.
    """
    clockwork = Clockwork(Simulation(HALLS, seed=1, robots=2))
    robots = [Robot("needy"), Robot("scout")]
    needy, scout = robots[NEEDY], robots[SCOUT]
    crate = (DOOR - 0.3, 1.2)
    with ExitStack() as stack:
        orchestrator = stack.enter_context(EmbeddedOrchestrator())
        operator = stack.enter_context(Client(orchestrator.url, orchestrator.operator_token))
        set_up(operator)
        for index, robot in enumerate(robots):
            token = operator.create_robot(RobotCreate(name=robot.name, services=("navigation",))).token
            start = HALLS.starts[index]
            config = AgentConfig(
                robot=robot.name,
                url=orchestrator.url,
                token=token,
                service="navigation",
                params={
                    "controller": "dwa",
                    "start": {"x": start.x, "y": start.y, "yaw": start.heading},
                    "rates": {"publish_global_costmap": 2.0},
                    # The machine may be busy: what is late is to be used all the same.
                    "sensors": {"scan_timeout": 5.0, "odometry_timeout": 5.0},
                },
                bind=("127.0.0.1", 0),
            )
            base = WorldHardware(clockwork, index, graph=robot.graph)
            stack.enter_context(Agent(config, base, graph=robot.graph))
        until(lambda: all(robot.status.get("localised") and robot.costmap for robot in robots), robots)
        until(lambda: any(scout.cost(crate[0] + dx, crate[1]) == 100 for dx in (-0.05, 0.0, 0.05)), robots)
        assert needy.status["neighbours"] == {}, "nobody said that they may"
        assert needy.cost(*crate) < 99

        for robot in robots:
            operator.set_group(robot.name, "hall")
        until(lambda: needy.status["neighbours"] == {"scout": "heard"}, robots)
        until(lambda: any(needy.cost(crate[0] + dx, crate[1]) == 100 for dx in (-0.05, 0.0, 0.05)), robots)
        look()
        needy.go(9.0, 1.2)
        until(lambda: len(needy.way) > 0, robots)
        at_the_door = needy.way[np.argmin(np.abs(needy.way[:, 0] - DOOR)), 1]
        assert at_the_door > 3.5, "round the crate that the other one sees"

        operator.set_group("scout", None)
        until(lambda: needy.status["neighbours"] == {}, robots)
        assert [robot.leaked for robot in robots] == [[], []], "it is not in the robots' graphs"
