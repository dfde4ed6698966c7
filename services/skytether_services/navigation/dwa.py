"""DWA: the dynamic window approach (Fox, Burgard and Thrun, 1997), as in move_base's dwa_local_planner.

Of the velocities that the robot can have after one period, each is driven on for a while; the best one is commanded. As
there, a trajectory's end is scored by its distance to the path and to the path's last pose in the window, measured
along free cells, and so is a point in front of the robot, which turns it along the path.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.service import param
from skytether_services.planar.geometry import Pose, advance, wrap

from .compiled import compiled
from .controller import Control, ControlStatus, FollowedPath, MotionLimits, PathController, turn_towards
from .costmap import INSCRIBED, LETHAL, UNKNOWN, Costmap, InflationParams
from .footprint import Footprint, FootprintChecks, footprint_cost

_INSCRIBED, _LETHAL, _UNKNOWN = INSCRIBED, LETHAL, UNKNOWN
_TURN_STEP = 0.05
"""Between headings that are checked of a turn on the spot [rad]."""
_STANDS = 0.05
"""A robot that is slower stands [m/s]."""
_SETTLED = 0.3
"""A turn on the spot ends slower than this: of the scores for an arc none would end it [rad/s]."""
_ALMOST = 0.1
"""So far from the goal's heading a turn at the goal need not be free: near enough counts [rad]."""
_SLOW = 0.2
"""As fast the robot drives away from what keeps it from turning [m/s]."""


@dataclass(frozen=True)
class DwaParams:
    """Sizes and weights."""

    linear_samples: int = param(20, ge=2, le=200, doc="forward velocities that are tried")
    angular_samples: int = param(41, ge=3, le=401, doc="turning rates that are tried with each")
    horizon: float = param(1.7, unit="s", gt=0, le=10, doc="how long each is driven on")
    step: float = param(0.05, unit="s", gt=0, le=0.5, doc="between poses that are checked")
    period: float = param(1 / 30, unit="s", gt=0, doc="of the controller")
    path_distance: float = param(16.0, unit="1/m", ge=0, doc="the end's distance to the path")
    goal_distance: float = param(12.0, unit="1/m", ge=0, doc="the end's way to the path's last pose in the window")
    front: float = param(0.325, unit="m", gt=0, doc="of the point in front that is scored likewise")
    occupied: float = param(0.01, ge=0, doc="largest cost of a cell on the way")
    change: float = param(0.5, unit="s/rad", ge=0, doc="change of the turning rate from the last command")
    goal_within: float = param(0.12, unit="m", gt=0, doc="nearer to the goal it stops and turns to the goal's heading")
    turn_from: float = param(1.0, unit="rad", gt=0, doc="it turns on the spot if the path leads off by more than this")
    turn_until: float = param(
        0.3, unit="rad", gt=0, doc="and until it leads off by less than this; near the goal both are less"
    )


@compiled
def spread(costs: NDArray[np.uint8], seeds: NDArray[np.int32]) -> NDArray[np.float32]:
    """Way along free cells from the nearest seed, in cells (four neighbours, as move_base's MapGrid); inf: none.

    Args:
        costs: Inflated, rows by columns.
        seeds: Indices of cells, row by row.
    """
    rows, columns = costs.shape
    flat = costs.ravel()
    distances = np.full(rows * columns, np.inf, dtype=np.float32)
    queue = np.empty(rows * columns, dtype=np.int32)
    head, tail = 0, 0
    for i in range(seeds.shape[0]):
        if distances[seeds[i]] > 0:
            distances[seeds[i]] = 0.0
            queue[tail] = seeds[i]
            tail += 1
    while head < tail:
        cell = queue[head]
        head += 1
        row, column = cell // columns, cell % columns
        following = distances[cell] + 1.0
        for side in range(4):
            r = row + (1 if side == 0 else -1 if side == 1 else 0)
            c = column + (1 if side == 2 else -1 if side == 3 else 0)
            if r < 0 or c < 0 or r >= rows or c >= columns:
                continue
            to = r * columns + c
            if distances[to] < np.inf or (flat[to] >= _INSCRIBED and flat[to] != _UNKNOWN):
                continue
            distances[to] = following
            queue[tail] = to
            tail += 1
    return distances.reshape(rows, columns)


@compiled
def best_velocity(
    pose: NDArray[np.float64],
    linear: NDArray[np.float64],
    angular: NDArray[np.float64],
    rate: float,
    timing: NDArray[np.float64],
    costs: NDArray[np.uint8],
    frame: NDArray[np.float64],
    samples: NDArray[np.float64],
    check_from: int,
    to_path: NDArray[np.float32],
    to_goal: NDArray[np.float32],
    weights: NDArray[np.float64],
    goal: NDArray[np.float64],
    near: bool,
) -> tuple[float, float, float]:
    """The best of the velocities, and its cost; infinite: all collide, or leave what was scored.

    Args:
        pose: x, y [m], yaw [rad].
        linear: Forward velocities to try [m/s]; of equals the first is taken.
        angular: Turning rates to try with each [rad/s].
        rate: The last command's turning rate [rad/s].
        timing: Horizon, step [s].
        costs: Inflated, rows by columns.
        frame: Resolution, and x, y of the corner of cell (0, 0) [m].
        samples: Of the footprint.
        check_from: As in ``footprint_cost``.
        to_path: Of ``spread``, from the path.
        to_goal: Of ``spread``, from its last pose in the window.
        weights: Path and goal [1/cell], front [m], occupied, change.
        goal: x, y of the path's end [m].
        near: It is so near that ends are scored by their distance from it, not by cells.
    """
    rows, columns = costs.shape
    steps = max(1, int(np.ceil(timing[0] / timing[1])))
    best, best_v, best_w = np.inf, 0.0, 0.0
    for i in range(linear.shape[0]):
        v = linear[i]
        for j in range(angular.shape[0]):
            w = angular[j]
            x, y, yaw = pose[0], pose[1], pose[2]
            worst = 0
            for _ in range(steps):
                half = 0.5 * w * timing[1]
                x += v * timing[1] * np.cos(yaw + half)
                y += v * timing[1] * np.sin(yaw + half)
                yaw += 2.0 * half
                cost = footprint_cost(
                    costs, frame[0], frame[1], frame[2], x, y, np.cos(yaw), np.sin(yaw), samples, check_from
                )
                worst = max(worst, cost)
                if cost == _LETHAL:
                    break
            if worst == _LETHAL:
                continue
            r, c = int((y - frame[2]) / frame[0]), int((x - frame[1]) / frame[0])
            fr = int((y + weights[2] * np.sin(yaw) - frame[2]) / frame[0])
            fc = int((x + weights[2] * np.cos(yaw) - frame[1]) / frame[0])
            if r < 0 or c < 0 or r >= rows or c >= columns or fr < 0 or fc < 0 or fr >= rows or fc >= columns:
                continue
            front = weights[2] / frame[0]
            if near:
                # A cell is too coarse now, and the way left too short to lead around anything.
                total = 2.0 * weights[1] * np.hypot(x - goal[0], y - goal[1]) / frame[0]
            else:
                total = weights[0] * to_path[r, c] + weights[1] * to_goal[r, c]
                # In front of the robot may be a wall, or the goal already behind the point.
                if to_goal[r, c] < front:
                    total += weights[0] * to_path[r, c]
                elif to_path[fr, fc] < np.inf:
                    total += weights[0] * to_path[fr, fc] + weights[1] * to_goal[fr, fc]
                else:
                    total += weights[0] * to_path[r, c] + weights[1] * (to_goal[r, c] + front)
            total += weights[3] * worst + weights[4] * abs(w - rate)
            if total < best:
                best, best_v, best_w = total, v, w
    return best_v, best_w, best


class Dwa(PathController):
    """A `Controller`."""

    def __init__(
        self,
        footprint: Footprint,
        limits: MotionLimits,
        inflation: InflationParams,
        params: DwaParams | None = None,
    ) -> None:
        """Begin without a path.

        Args:
            footprint: Of the robot.
            limits: Likewise.
            inflation: Of the costmaps to come: it tells from which cost on a polygon is looked at.
            params: Sizes and weights.
        """
        super().__init__()
        self._params = params or DwaParams()
        self._limits = limits
        self._checks = FootprintChecks(footprint, inflation)
        self._rate = 0.0
        self._turning = False
        self._at_goal = False

    def set_path(self, path: NDArray[np.float64]) -> None:
        goal = self._path.goal if self._path is not None else None
        super().set_path(path)
        if self._path is None or goal is None or math.dist(goal[:2], self._path.goal[:2]) > self._params.goal_within:
            self._at_goal = False

    def reset(self) -> None:
        self._rate, self._turning, self._at_goal = 0.0, False, False

    def drive(
        self, path: FollowedPath, pose: Pose, velocity: Velocity, costmap: Costmap, speed_limit: float
    ) -> Control:
        goal = path.goal
        poses = path.ahead(pose.x, pose.y, math.inf, costmap.resolution)
        near = math.dist(pose[:2], goal[:2])
        if near <= self._params.goal_within and path.left() < 1.0:
            self._at_goal = True
        elif near > 2.5 * self._params.goal_within:
            self._at_goal = False
        if self._at_goal:
            return self._turn(pose, velocity, costmap, goal.yaw - pose.yaw, _ALMOST)
        ahead = poses[min(len(poses) - 1, math.ceil(2 * self._params.front / costmap.resolution))]
        away = math.dist(ahead[:2], pose[:2])
        error = wrap(math.atan2(ahead[1] - pose.y, ahead[0] - pose.x) - pose.yaw) if away > 0.1 else 0.0
        # The last piece is too short for an arc: face the goal, then go straight.
        ease = self._params.turn_until / self._params.turn_from if near < self._params.front else 1.0
        # One that stands turns first: what it can reach at once ends in so few cells that to stand may seem the best.
        limit = self._params.turn_until if self._turning or abs(velocity.linear) < _STANDS else self._params.turn_from
        still_turning = self._turning and abs(velocity.angular) > _SETTLED
        self._turning = abs(error) > limit * ease or still_turning
        if self._turning:
            # So far it has to turn; the rest is for an arc.
            control = self._turn(pose, velocity, costmap, error, self._params.turn_until * ease)
            if control.status is ControlStatus.DRIVING:
                return control
            away_from_it = self._make_room(pose, velocity, costmap, speed_limit)
            if away_from_it is not None:
                return away_from_it
        return self._choose(pose, velocity, costmap, poses, path.left(), speed_limit)

    def _choose(
        self,
        pose: Pose,
        velocity: Velocity,
        costmap: Costmap,
        path: NDArray[np.float64],
        left: float,
        speed_limit: float,
    ) -> Control:
        params, limits = self._params, self._limits
        seeds = self._cells(costmap, path)
        if len(seeds) == 0:
            return Control(STANDSTILL, ControlStatus.BLOCKED)
        to_path, to_goal = spread(costmap.costs, seeds), spread(costmap.costs, seeds[-1:])
        fastest = max(min(limits.max_linear, speed_limit), 0.0)
        dv, dw = limits.linear_acceleration * params.period, limits.angular_acceleration * params.period
        # It must be able to stop at the goal; a speed that is above the limit goes down as fast as it may.
        fastest = min(fastest, max(math.sqrt(2 * 0.7 * limits.linear_acceleration * left), 0.05))
        low = max(velocity.linear - dv, -limits.max_backward)
        high = max(min(velocity.linear + dv, fastest), low)
        low = min(low, high)
        # The fastest first: ends in the same cell score alike.
        linear = np.linspace(high, low, params.linear_samples)
        angular = np.linspace(
            max(velocity.angular - dw, -limits.max_angular),
            min(velocity.angular + dw, limits.max_angular),
            params.angular_samples,
        )
        # To drive straight on, and to stand, are always among them if they can be had.
        if angular[0] < 0 < angular[-1]:
            angular[np.abs(angular).argmin()] = 0.0
        if low < 0 < high:
            linear[np.abs(linear).argmin()] = 0.0
        frame, samples, check_from = self._checks.on(costmap)
        cells = costmap.resolution
        weights = np.array(
            [params.path_distance * cells, params.goal_distance * cells, params.front, params.occupied, params.change]
        )
        # A trajectory keeps its velocity to its end, but the robot will brake. Driven on beyond the goal a fast one
        # would score worse than a slow one: the robot would come nearer by a constant share of the way each second.
        horizon = min(params.horizon, max(left / max(fastest, 1e-3), 2 * params.step))
        timing = np.array([horizon, params.step])
        v, w, best = best_velocity(
            np.array(pose), linear, angular, self._rate, timing,
            costmap.costs, frame, samples, check_from, to_path, to_goal, weights,
            path[-1, :2], left < params.front + 0.1,
        )  # fmt: skip
        if not math.isfinite(best):
            self._rate = 0.0
            return Control(STANDSTILL, ControlStatus.BLOCKED)
        self._rate = w
        return Control(Velocity(v, w), ControlStatus.DRIVING, self._trajectory(pose, Velocity(v, w)))

    def _turn(self, pose: Pose, velocity: Velocity, costmap: Costmap, error: float, enough: float = 0.0) -> Control:
        """On the spot, after braking, where there is room for it; the long way round where only that is free.

        Args:
            pose: Of the robot.
            velocity: Likewise.
            costmap: Around it.
            error: Desired minus actual yaw [rad].
            enough: It need not come nearer to it than this [rad].
        """
        limits, dt = self._limits, self._params.period
        error = wrap(error)
        rest = max(abs(error) - enough, 0.0)
        if not self._is_turn_free(pose, costmap, math.copysign(rest, error)):
            round_it = error - math.copysign(math.tau, error)
            if not self._is_turn_free(pose, costmap, round_it + math.copysign(enough, error)):
                self._rate = 0.0
                return Control(STANDSTILL, ControlStatus.BLOCKED)
            # Less than half a turn of it, so that it is that way which is taken; for more it is still the fastest.
            error = math.copysign(min(abs(round_it), 0.9 * math.pi), round_it)
        linear = velocity.linear - math.copysign(
            min(limits.linear_acceleration * dt, abs(velocity.linear)), velocity.linear
        )
        rate = turn_towards(error, velocity.angular, limits, dt)
        trajectory = self._trajectory(pose, Velocity(linear, rate))[: math.ceil(0.5 / self._params.step)]
        if self._collides(trajectory, costmap):
            self._rate = 0.0
            return Control(STANDSTILL, ControlStatus.BLOCKED)
        self._rate = rate
        return Control(Velocity(linear, rate), ControlStatus.DRIVING, trajectory)

    def _is_turn_free(self, pose: Pose, costmap: Costmap, turn: float) -> bool:
        steps = math.ceil(abs(turn) / _TURN_STEP)
        yaws = pose.yaw + turn * np.arange(1, steps + 1) / max(steps, 1)
        return not self._collides(np.column_stack((np.full((steps, 2), pose[:2]), yaws)), costmap)

    def _collides(self, poses: NDArray[np.float64], costmap: Costmap) -> bool:
        frame, samples, check_from = self._checks.on(costmap)
        return any(
            footprint_cost(
                costmap.costs, frame[0], frame[1], frame[2], x, y, math.cos(yaw), math.sin(yaw), samples, check_from
            )
            == LETHAL
            for x, y, yaw in poses.tolist()
        )

    def _make_room(self, pose: Pose, velocity: Velocity, costmap: Costmap, speed_limit: float) -> Control | None:
        """Away from what keeps the robot from turning on the spot; None: there is no such way.

        A window of velocities that can be had at once tells nothing here: a robot that stands beside a wall gets
        nowhere in it. So slow arcs of all radii are looked at, to where obstacles are farther off than here.
        """
        limits, params = self._limits, self._params
        here = costmap.cell(pose.x, pose.y)
        if here is None:
            return None
        costs = costmap.costs
        room = np.where((costs < INSCRIBED) | (costs == UNKNOWN), costs, np.inf).astype(np.float32)
        room[costs == UNKNOWN] = 0.0
        ahead = max(min(_SLOW, limits.max_linear, speed_limit), 0.0)
        linear = np.array([ahead, -min(limits.max_backward, ahead), ahead / 2])
        angular = np.linspace(-limits.max_angular, limits.max_angular, params.angular_samples)
        frame, samples, check_from = self._checks.on(costmap)
        weights = np.array([0.5, 0.0, params.front, 0.0, params.change])
        v, w, best = best_velocity(
            np.array(pose), linear, angular, self._rate, np.array([params.horizon, params.step]),
            costs, frame, samples, check_from, room, np.zeros_like(room), weights, np.array(pose[:2]), False,
        )  # fmt: skip
        if not best < room[here]:
            return None
        dv, dw = limits.linear_acceleration * params.period, limits.angular_acceleration * params.period
        command = Velocity(
            min(max(v, velocity.linear - dv), velocity.linear + dv),
            min(max(w, velocity.angular - dw), velocity.angular + dw),
        )
        trajectory = self._trajectory(pose, command)
        if self._collides(trajectory[: math.ceil(0.5 / params.step)], costmap):
            return None
        self._rate = w
        return Control(command, ControlStatus.DRIVING, trajectory)

    def _trajectory(self, pose: Pose, velocity: Velocity) -> NDArray[np.float64]:
        times = np.arange(1, math.ceil(self._params.horizon / self._params.step) + 1) * self._params.step
        return np.array([advance(pose, velocity.linear, velocity.angular, t) for t in times.tolist()])

    def _cells(self, costmap: Costmap, path: NDArray[np.float64]) -> NDArray[np.int32]:
        """Cells of the path from beside the robot to where it leaves the window; not those that are blocked."""
        rows, columns = costmap.costs.shape
        at = np.floor((path[:, :2] - costmap.origin) / costmap.resolution).astype(int)
        inside = (at[:, 0] >= 0) & (at[:, 1] >= 0) & (at[:, 0] < columns) & (at[:, 1] < rows)
        if not inside.all():
            at = at[: int(inside.argmin())]
        costs = costmap.costs[at[:, 1], at[:, 0]]
        at = at[(costs < INSCRIBED) | (costs == UNKNOWN)]
        cells: NDArray[np.int32] = (at[:, 1] * columns + at[:, 0]).astype(np.int32)
        return cells
