"""MPPI: model predictive path integral control (Williams et al., 2016), with the critics of Nav2.

Each step drives many trajectories, whose velocities are those planned before plus noise, adds up what each costs, and
plans the mean with the weights exp(-cost / temperature). The plan moves on by one period of the controller each time,
and is smoothed by a Savitzky-Golay filter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.service import param
from skytether_services.planar.geometry import Pose

from .controller import Control, ControlStatus, FollowedPath, MotionLimits, PathController
from .costmap import INSCRIBED, Costmap, InflationParams
from .footprint import Footprint, FootprintChecks
from .mppi_kernels import (
    COLLISION,
    correlate,
    furthest,
    motion_costs,
    obstacle_costs,
    path_costs,
    rollout,
    weighted_mean,
)

_FILTER = np.array([-21.0, 14.0, 39.0, 54.0, 59.0, 54.0, 39.0, 14.0, -21.0]) / 231.0
"""Savitzky and Golay: quadratic, over nine values."""
_SPACING = 0.05
"""Of the path's poses that trajectories are compared with [m]."""


@dataclass(frozen=True)
class MppiParams:
    """Sizes and weights; the defaults are near Nav2's."""

    trajectories: int = param(1000, ge=10, le=20_000, doc="how many are tried in each step")
    steps: int = param(56, ge=5, le=500, doc="of a trajectory")
    step: float = param(0.05, unit="s", gt=0, le=0.2, doc="length of one")
    period: float = param(1 / 30, unit="s", gt=0, doc="of the controller; the plan moves on by it each time")
    linear_noise: float = param(0.2, unit="m/s", gt=0, doc="standard deviation of the forward velocity's noise")
    angular_noise: float = param(0.4, unit="rad/s", gt=0, doc="standard deviation of the turning rate's noise")
    noise_time: float = param(
        1.0,
        unit="s",
        ge=0,
        doc="how long noise lasts (time constant); 0: anew in each step, as in Nav2, which tries less",
    )
    noise_share: float = param(
        0.125, gt=0, le=1, doc="share of the trajectories whose noise is drawn anew in each step"
    )
    temperature: float = param(0.3, gt=0, doc="the lower, the more the best trajectories count alone")
    gamma: float = param(0.015, ge=0, doc="price of leaving what was planned before")
    path_follow: float = param(5.0, unit="1/m", ge=0, doc="distance of the end to the path's pose a little ahead")
    path_align: float = param(14.0, unit="1/m", ge=0, doc="mean distance to the path")
    path_angle: float = param(
        2.0, unit="1/rad", ge=0, doc="mean direction off the path's pose ahead, where it is behind"
    )
    path_angle_from: float = param(1.0, unit="rad", ge=0, doc="only if that pose is more than this to the side")
    goal: float = param(5.0, unit="1/m", ge=0, doc="mean distance to the goal")
    goal_within: float = param(1.4, unit="m", gt=0, doc="only near it; there the path is not followed any more")
    goal_angle: float = param(3.0, unit="1/rad", ge=0, doc="mean heading off the goal's")
    goal_angle_within: float = param(0.5, unit="m", gt=0, doc="only near it; there the path is not aligned to any more")
    cost: float = param(3.81, ge=0, doc="mean cost of the cells on the way, per 254")
    prefer_forward: float = param(5.0, unit="1/m", ge=0, doc="way driven backwards")
    constraint: float = param(4.0, unit="1/m", ge=0, doc="way that a wheel would turn beyond its largest speed")
    aim_ahead: int = param(5, ge=0, doc="poses of the path (5 cm each) beyond the furthest that a trajectory reaches")
    align_occupied: float = param(
        0.07, ge=0, le=1, doc="the path is not aligned to if more of it than this share is blocked: go around"
    )
    obstacle_stride: int = param(2, ge=1, doc="each how many steps the footprint is checked")
    path_stride: int = param(4, ge=1, doc="each how many steps the path is compared with")
    track: float = param(0.4, unit="m", gt=0, doc="distance between the driven wheels")
    wheel_speed: float = param(0.8, unit="m/s", gt=0, doc="largest of a wheel")


class Mppi(PathController):
    """A `Controller`."""

    def __init__(
        self,
        footprint: Footprint,
        limits: MotionLimits,
        inflation: InflationParams,
        rng: np.random.Generator,
        params: MppiParams | None = None,
    ) -> None:
        """Begin without a path.

        Args:
            footprint: Of the robot.
            limits: Likewise.
            inflation: Of the costmaps to come: it tells from which cost on a polygon is looked at.
            rng: For the noise.
            params: Sizes and weights.
        """
        super().__init__()
        self._params = params = params or MppiParams()
        self._limits, self._rng = limits, rng
        self._checks = FootprintChecks(footprint, inflation)
        n, steps = params.trajectories, params.steps
        self._lasting = math.exp(-params.step / params.noise_time) if params.noise_time > 0 else 0.0
        self._noise = np.zeros((2, n, steps), dtype=np.float32)
        self._next_noise = 1
        self._draw(1, n)
        self._controls = np.empty((2, n, steps), dtype=np.float32)
        self._poses = np.empty((n, steps, 4), dtype=np.float32)
        self._total = np.empty(n)
        self._planned = np.zeros((2, steps))
        self._before = np.zeros((2, len(_FILTER) // 2))
        self._fresh = True

    def reset(self) -> None:
        self._fresh = True

    def drive(
        self, path: FollowedPath, pose: Pose, velocity: Velocity, costmap: Costmap, speed_limit: float
    ) -> Control:
        params, limits = self._params, self._limits
        if self._fresh:
            # Go on from what the robot does.
            self._planned[:] = self._before[:] = np.array(velocity)[:, None]
            self._fresh = False
        self._shift()
        self._refresh()
        fastest = max(min(limits.max_linear, speed_limit), 0.0)
        bounds = np.array(
            [
                -min(limits.max_backward, fastest),
                fastest,
                limits.max_angular,
                limits.linear_acceleration,
                limits.angular_acceleration,
            ]
        )
        start = np.array([*pose, *velocity])
        rollout(self._planned, self._noise, start, params.step, bounds, self._controls, self._poses)
        free = self._score(pose, path, costmap, fastest)
        if free == 0:
            self.reset()
            return Control(STANDSTILL, ControlStatus.BLOCKED)
        weighted_mean(self._controls, self._total, params.temperature, self._planned)
        self._smooth(velocity, bounds)
        command = Velocity(float(self._planned[0, 0]), float(self._planned[1, 0]))
        trajectory, collides = self._predict(start, bounds, costmap)
        if collides:
            # The mean of ways around both sides may lead between them: then the best one, as it is.
            best = int(self._total.argmin())
            self._planned[:] = self._controls[:, best]
            command = Velocity(float(self._planned[0, 0]), float(self._planned[1, 0]))
            trajectory, _ = self._predict(start, bounds, costmap)
        self._before = np.column_stack((self._before[:, 1:], np.array(command)))
        return Control(command, ControlStatus.DRIVING, trajectory)

    def _draw(self, first: int, last: int) -> None:
        """Noise of some trajectories; the first one has none: it drives what was planned."""
        scales = (self._params.linear_noise, self._params.angular_noise)
        for part, scale in zip(self._noise[:, first:last], scales, strict=True):
            self._rng.standard_normal(out=part, dtype=np.float32)
            correlate(part, self._lasting)
            part *= np.float32(scale)

    def _refresh(self) -> None:
        n = self._params.trajectories
        last = min(self._next_noise + math.ceil(n * self._params.noise_share), n)
        self._draw(self._next_noise, last)
        self._next_noise = last if last < n else 1

    def _shift(self) -> None:
        """Move the plan on by a period: its end stays what it is."""
        times = np.arange(self._params.steps) * self._params.step
        for row in self._planned:
            row[:] = np.interp(times + self._params.period, times, row)

    def _score(self, pose: Pose, followed: FollowedPath, costmap: Costmap, fastest: float) -> int:
        """Costs of all trajectories; returns how many do not collide."""
        params = self._params
        total = self._total
        total[:] = 0.0
        goal = followed.goal
        reach = fastest * params.step * params.steps
        path = followed.ahead(pose.x, pose.y, reach + 1.0, _SPACING)
        valid = np.array([costmap.at(x, y) not in (INSCRIBED, INSCRIBED + 1) for x, y, _ in path])
        path[:, 0] -= pose.x
        path[:, 1] -= pose.y
        away = math.hypot(goal.x - pose.x, goal.y - pose.y)
        left = followed.left()
        # On a path that comes by its goal before it ends there the goal is not near yet.
        near_goal = away < params.goal_within and left < params.goal_within * 1.5
        last_turn = away < params.goal_angle_within and near_goal
        frame, samples, check_from = self._checks.on(costmap)
        free = obstacle_costs(
            self._poses, pose.x, pose.y, costmap.costs, frame, samples, check_from, params.obstacle_stride,
            params.cost, away < params.goal_angle_within, total,
        )  # fmt: skip
        if free == 0:
            return 0
        reached = furthest(self._poses, path)
        aim = min(reached + params.aim_ahead, len(path) - 1)
        while aim < len(path) - 1 and not valid[aim]:
            aim += 1
        bearing = math.atan2(path[aim, 1], path[aim, 0]) - pose.yaw
        behind = abs(math.remainder(bearing, math.tau)) > params.path_angle_from and not last_turn
        occupied = 1.0 - float(valid[: aim + 1].mean())
        align = not last_turn and occupied <= params.align_occupied and left > 2 * _SPACING
        weights = np.array(
            [
                0.0 if near_goal else params.path_follow,
                params.path_align if align else 0.0,
                params.path_angle if behind else 0.0,
            ]
        )
        path_costs(
            self._controls, self._poses, path, valid, aim, params.step, _SPACING, params.path_stride, weights, total
        )
        end = np.array([goal.x - pose.x, goal.y - pose.y, goal.yaw])
        weights = np.array(
            [
                params.goal if near_goal else 0.0,
                params.goal_angle if last_turn else 0.0,
                0.0 if last_turn else params.prefer_forward,
                params.constraint,
            ]
        )
        pull = params.gamma / np.array([params.linear_noise**2, params.angular_noise**2])
        wheels = np.array([params.track / 2, params.wheel_speed])
        motion_costs(self._planned, self._controls, self._poses, end, params.step, wheels, weights, pull, total)
        return free

    def _smooth(self, velocity: Velocity, bounds: NDArray[np.float64]) -> None:
        half = len(_FILTER) // 2
        for row, before in zip(self._planned, self._before, strict=True):
            padded = np.concatenate((before, row, np.full(half, row[-1])))
            row[:] = np.convolve(padded, _FILTER, mode="valid")
        np.clip(self._planned[0], bounds[0], bounds[1], out=self._planned[0])
        np.clip(self._planned[1], -bounds[2], bounds[2], out=self._planned[1])
        for row, speed, most in zip(self._planned, velocity, bounds[3:], strict=True):
            change = most * self._params.step
            row[0] = min(max(row[0], speed - change), speed + change)

    def _predict(
        self, start: NDArray[np.float64], bounds: NDArray[np.float64], costmap: Costmap
    ) -> tuple[NDArray[np.float64], bool]:
        """Where the plan leads, and whether it collides."""
        steps = self._params.steps
        still = np.zeros((2, 1, steps), dtype=np.float32)
        controls, poses = np.empty((2, 1, steps), np.float32), np.empty((1, steps, 4), np.float32)
        rollout(self._planned, still, start, self._params.step, bounds, controls, poses)
        frame, samples, check_from = self._checks.on(costmap)
        total = np.zeros(1)
        obstacle_costs(poses, start[0], start[1], costmap.costs, frame, samples, check_from, 1, 0.0, False, total)
        yaws = np.arctan2(poses[0, :, 3], poses[0, :, 2])
        trajectory = np.column_stack((poses[0, :, 0] + start[0], poses[0, :, 1] + start[1], yaws))
        return trajectory, bool(total[0] >= COLLISION)
