"""Two robots in one simulated building, each with a service of its own, and made-up time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from two_halls import DOOR, HALLS, NEEDY, SCOUT

from skytether.lab.trail import Pose
from skytether.lab.world.occupancy import Occupancy
from skytether.lab.world.simulation import TICK, Simulation
from skytether.messages import Header, Point, PoseStamped, String
from skytether.messages import Pose as PoseMessage
from skytether.testing.service import Harness
from skytether_services.navigation.costmap import FREE, LETHAL, Costmap, static_costs
from skytether_services.navigation.grid_map import load_map
from skytether_services.navigation.service import Navigation
from skytether_services.navigation.shared_word import Word, map_id, write_word
from skytether_services.planar.geometry import Pose as MapPose

pytestmark = pytest.mark.slow

_STEP, _EXCHANGE = 1 / 30, 1.0


class Pair:
    """Both robots, and what their agents and the orchestrator carry between their services."""

    def __init__(self, folder: Path, *, shares: bool = True, **params: Any) -> None:
        Occupancy(HALLS).save(folder / "map")
        self.world = Simulation(HALLS, seed=1, robots=2)
        self.services = []
        for start in HALLS.starts:
            known = {"map": "map.yaml", "start": {"x": start.x, "y": start.y, "yaw": start.heading}}
            self.services.append(Harness(Navigation, {"controller": "dwa", **known, **params}, data_dir=folder))
        self.shares = shares
        self.false_word = ""
        """What the second robot says instead of what its service does."""
        self._due = self._exchange = self.services[0].now

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / TICK)):
            self._tick()

    def _tick(self) -> None:
        now = self.services[0].now + TICK
        for service, readings in zip(self.services, self.world.tick(now), strict=True):
            service.now = now
            for topic, message in readings:
                if topic in ("tf", "odom", "scan"):
                    service.send(topic, message)
        if now + 1e-9 >= self._due:
            self._due += _STEP
            for service, robot in zip(self.services, self.world.robots, strict=True):
                service.step(0.0)
                robot.write(service.newest("cmd_vel"))
        if self.shares and now >= self._exchange:
            self._exchange += _EXCHANGE
            self._carry()

    def _carry(self) -> None:
        for index, service in enumerate(self.services):
            other = self.services[1 - index]
            said = other.newest("obstacles_seen")
            text = self.false_word if self.false_word and index == NEEDY else said.data if said else ""
            others = [{"robot": f"robot-{1 - index}", "age_s": 0.3, "text": text}] if text else []
            service.send("obstacles_shared", String(json.dumps(others)))

    def go(self, x: float = 9.0, y: float = 1.2) -> None:
        self.services[NEEDY].send("goal", PoseStamped(Header(frame_id="map"), PoseMessage(Point(x, y))))

    @property
    def status(self) -> dict[str, Any]:
        newest: dict[str, Any] = json.loads(self.services[NEEDY].newest("status").data)
        return newest

    @property
    def way(self) -> NDArray[np.float64]:
        """The first robot's plan, n by 2."""
        poses = self.services[NEEDY].newest("plan").poses
        return np.array([(p.pose.position.x, p.pose.position.y) for p in poses])

    def at_the_door(self) -> float:
        """Where its plan goes through the wall: y [m]."""
        return float(self.way[np.argmin(np.abs(self.way[:, 0] - DOOR)), 1])


def test_what_one_robot_sees_the_other_goes_round(tmp_path: Path) -> None:
    pair = Pair(tmp_path)
    pair.run(4.0)
    assert pair.status["neighbours"] == {"robot-1": "heard"}
    pair.go()
    pair.run(1.0)
    assert pair.at_the_door() > 3.5
    for _ in range(60):
        pair.run(1.0)
        if pair.status["state"] == "succeeded":
            break
    assert pair.status["state"] == "succeeded", pair.status
    assert not pair.world.contacts
    driven = pair.world.robots[NEEDY].distance
    assert driven < 12.0, "it did not go to look at the crate first"


def test_without_sharing_it_does_not_know(tmp_path: Path) -> None:
    pair = Pair(tmp_path, shares=False)
    pair.run(4.0)
    assert pair.status["neighbours"] == {}
    pair.go()
    pair.run(1.0)
    assert 0.6 < pair.at_the_door() < 1.8
    assert not pair.services[SCOUT].outputs["obstacles_seen"], "there is nobody to tell"


def test_the_other_robots_body_is_gone_round_and_is_no_wall(tmp_path: Path) -> None:
    """The robot plans past the other one, 4 m away and beyond what it marks by its own laser; where that has gone, the
    way is free."""
    pair = Pair(tmp_path)
    pair.run(3.0)
    pair.go(6.0, 2.6)
    pair.run(1.0)
    scout = np.array(pair.world.robots[SCOUT].pose[:2])
    assert np.hypot(*(pair.way - scout).T).min() > 0.6, "half a robot each"
    pair.world.place(SCOUT, Pose(9.0, 4.0, 0.0))
    pair.shares = False
    pair.run(6.0)
    whole = pair.services[NEEDY].service.navigator.surroundings.whole
    assert whole.at(*scout) < LETHAL


def test_a_neighbour_that_lies_makes_no_goal_unreachable(tmp_path: Path) -> None:
    pair = Pair(tmp_path)
    grid = load_map(tmp_path / "map.yaml")
    static = Costmap(static_costs(grid.cells), grid.resolution, grid.origin[:2])
    column = int((6.0 - static.origin[0]) / static.resolution)
    rows = np.flatnonzero(static.costs[:, column] == FREE)
    wall = np.column_stack((rows, np.full(len(rows), column)))
    corners = np.array([[0.3, 0.3], [-0.3, 0.3], [-0.3, -0.3], [0.3, -0.3]])
    pair.false_word = write_word(map_id(static), Word(MapPose(9.0, 4.0, 0.0), corners, wall, np.zeros(len(wall))))
    pair.run(3.0)
    surroundings = pair.services[NEEDY].service.navigator.surroundings
    assert surroundings.whole.at(6.0, 4.1) == LETHAL, "it is believed"
    assert surroundings.own.at(6.0, 4.1) < LETHAL
    pair.go()
    pair.run(8.0)
    assert pair.status["state"] == "driving", pair.status
    assert pair.world.robots[NEEDY].distance > 1.5, "it goes and looks"
