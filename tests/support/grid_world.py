"""A small world of cells and a robot that drives in it, without physics: for navigation's closed loops."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from skytether.control.admittance import STANDSTILL, Velocity
from skytether_services.navigation.checkers import GoalChecker, GoalParams
from skytether_services.navigation.controller import Controller, ControlStatus, MotionLimits
from skytether_services.navigation.costmap import LETHAL, Costmap, InflationParams
from skytether_services.navigation.footprint import Footprint
from skytether_services.navigation.layers import LayeredCostmap, WindowParams
from skytether_services.navigation.obstacles import Scan
from skytether_services.navigation.planner import PlannerParams, PlanStatus, plan
from skytether_services.navigation.prediction import DelayParams, PredictedState, State
from skytether_services.planar.geometry import Pose, advance

RESOLUTION = 0.05
PERIOD = 1 / 30
RAYS = 181
LIMITS = MotionLimits()
INFLATION = InflationParams(radius=0.7)


def corridor() -> tuple[np.ndarray, np.ndarray]:
    """12 m by 5 m: walls, a corridor of 2 m that turns a corner into another; without and with a box in the way."""
    known = np.full((100, 240), LETHAL, dtype=np.uint8)
    known[10:50, 4:236] = 0
    known[10:96, 180:230] = 0
    boxed = known.copy()
    boxed[10:28, 90:100] = LETHAL
    return known, boxed


def look(world: np.ndarray, pose: Pose) -> Scan:
    """What a laser at the robot's centre sees, half a circle of rays by steps of a quarter of a cell."""
    angles = np.linspace(-math.pi / 2, math.pi / 2, RAYS) + pose.yaw
    reach = np.arange(0.0, 6.0, RESOLUTION / 4)
    columns = ((pose.x + np.cos(angles)[:, None] * reach) / RESOLUTION).astype(int).clip(0, world.shape[1] - 1)
    rows = ((pose.y + np.sin(angles)[:, None] * reach) / RESOLUTION).astype(int).clip(0, world.shape[0] - 1)
    hits = world[rows, columns] == LETHAL
    ranges = np.where(hits.any(axis=1), reach[hits.argmax(axis=1)] + RESOLUTION / 4, np.inf)
    return Scan(ranges.astype(np.float32), -math.pi / 2, math.pi / (RAYS - 1), pose)


@dataclass
class Drive:
    """How it went."""

    seconds: float = 0.0
    reached: bool = False
    touched: int = 0
    blocked: int = 0
    way: list[Pose] = field(default_factory=list)


def drive(
    controller: Controller,
    footprint: Footprint,
    *,
    start: Pose,
    goal: Pose,
    round_trip: float,
    delay: DelayParams,
    limit: float = 60.0,
) -> Drive:
    """One robot, from its start to its goal: poses arrive half a round trip late, commands the other half.

    The box is on no map: the laser sees it. The true world judges whether the footprint touches anything.
    """
    known, world = corridor()
    truth = Costmap(world, RESOLUTION)
    exact = Footprint(footprint.radius, footprint.corners, 0.0)
    checks = exact.samples(RESOLUTION / 2) if exact.corners else _disc(exact.radius)
    whole = LayeredCostmap(Costmap(known, RESOLUTION), footprint, inflation=INFLATION)
    near = LayeredCostmap(Costmap(known, RESOLUTION), footprint, inflation=INFLATION, rolling=WindowParams())
    predicted, goals = PredictedState(delay), GoalChecker(GoalParams())
    state = State(start, STANDSTILL, 0.0)
    one_way = round_trip / 2
    seen: deque[tuple[float, State, Scan]] = deque()
    flying: deque[tuple[float, Velocity]] = deque()
    command, latest = STANDSTILL, None
    result, planned = Drive(), False
    ticks = round(limit / PERIOD)
    for tick in range(ticks):
        now = tick * PERIOD
        seen.append((now + one_way, state, look(world, state.pose)))
        while seen and seen[0][0] <= now + 1e-9:
            latest = seen.popleft()
        if latest is not None:
            _, old, scan = latest
            if not planned or tick % 30 == 0:
                found = plan(whole.update(old.pose, scan), old.pose, goal, PlannerParams())
                if found.status is PlanStatus.FOUND:
                    controller.set_path(found.path)
                    planned = True
            local = near.update(old.pose, scan)
            arrival = predicted.at_arrival(old, now, one_way)
            if goals.reached(old.pose, old.velocity, goal):
                result.reached, result.seconds = True, now
                return result
            control = controller.control(arrival.pose, arrival.velocity, local)
            result.blocked += control.status is ControlStatus.BLOCKED
            predicted.sent(control.velocity, now, one_way)
            flying.append((now + one_way, control.velocity))
        while flying and flying[0][0] <= now + 1e-9:
            command = flying.popleft()[1]
        state = _move(state, command)
        result.way.append(state.pose)
        result.touched += _touches(truth, checks, state.pose)
    result.seconds = limit
    return result


def _move(state: State, command: Velocity) -> State:
    """The robot's own limits of acceleration hold whatever it is told."""
    dv, dw = LIMITS.linear_acceleration * PERIOD, LIMITS.angular_acceleration * PERIOD
    v = min(max(command.linear, state.velocity.linear - dv), state.velocity.linear + dv)
    w = min(max(command.angular, state.velocity.angular - dw), state.velocity.angular + dw)
    mean = ((v + state.velocity.linear) / 2, (w + state.velocity.angular) / 2)
    return State(advance(state.pose, *mean, PERIOD), Velocity(v, w), state.time + PERIOD)


def _disc(radius: float) -> np.ndarray:
    angles = np.linspace(0, math.tau, 72, endpoint=False)
    return np.concatenate(
        [r * np.column_stack((np.cos(angles), np.sin(angles))) for r in np.linspace(0.02, radius, 12)]
    )


def _touches(truth: Costmap, checks: np.ndarray, pose: Pose) -> bool:
    cos, sin = math.cos(pose.yaw), math.sin(pose.yaw)
    at = checks @ np.array([[cos, sin], [-sin, cos]]) + pose[:2]
    cells = np.floor(at / RESOLUTION).astype(int)
    return bool((truth.costs[cells[:, 1], cells[:, 0]] == LETHAL).any())
