"""The inner loops of MPPI: trajectories from noise, their costs, and the weighted mean."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .compiled import compiled
from .costmap import INSCRIBED, LETHAL
from .footprint import footprint_cost

_INSCRIBED, _LETHAL = INSCRIBED, LETHAL

COLLISION = 1e6
"""Added to the cost of a trajectory that collides: it gets no weight beside any other."""
_COLLISION = COLLISION


@compiled
def correlate(noise: NDArray[np.float32], share: float) -> None:
    """Make white noise of variance 1 last, in place: each step keeps a share of the one before, and the variance.

    Args:
        noise: Trajectories by steps.
        share: From 0 (stays white) to 1.
    """
    rest = np.sqrt(1.0 - share * share)
    for k in range(noise.shape[0]):
        for t in range(1, noise.shape[1]):
            noise[k, t] = share * noise[k, t - 1] + rest * noise[k, t]


@compiled
def rollout(
    planned: NDArray[np.float64],
    noise: NDArray[np.float32],
    start: NDArray[np.float64],
    dt: float,
    limits: NDArray[np.float64],
    controls: NDArray[np.float32],
    poses: NDArray[np.float32],
) -> None:
    """Drive each trajectory with the planned velocities and its noise, within the robot's limits.

    Args:
        planned: Forward velocity [m/s] and turning rate [rad/s] of each step, 2 by steps.
        noise: Likewise, 2 by trajectories by steps.
        start: x, y [m], yaw [rad], forward velocity, turning rate: of the robot when the first step begins.
        dt: Of a step [s].
        limits: Smallest and largest forward velocity, largest turning rate, both accelerations.
        controls: Out: the velocities driven, 2 by trajectories by steps.
        poses: Out: x, y (from the start's), cosine and sine of the yaw after each step, trajectories by steps by 4.
    """
    n, steps = noise.shape[1], noise.shape[2]
    low, high, most = limits[0], limits[1], limits[2]
    dv, dw = limits[3] * dt, limits[4] * dt
    for k in range(n):
        x, y = 0.0, 0.0
        c, s = np.cos(start[2]), np.sin(start[2])
        v, w = start[3], start[4]
        for t in range(steps):
            wish = min(max(planned[0, t] + noise[0, k, t], low), high)
            v = min(max(wish, v - dv), v + dv)
            wish = min(max(planned[1, t] + noise[1, k, t], -most), most)
            w = min(max(wish, w - dw), w + dw)
            # Half a turn, the way, the other half. The series are good to 1e-7 for the half of 0.2 rad.
            half = 0.5 * w * dt
            square = half * half
            ds = half * (1.0 - square * (1.0 / 6.0 - square / 120.0))
            dc = 1.0 - square * (0.5 - square / 24.0)
            cm, sm = c * dc - s * ds, s * dc + c * ds
            x += v * dt * cm
            y += v * dt * sm
            c, s = cm * dc - sm * ds, sm * dc + cm * ds
            controls[0, k, t] = v
            controls[1, k, t] = w
            poses[k, t, 0] = x
            poses[k, t, 1] = y
            poses[k, t, 2] = c
            poses[k, t, 3] = s


@compiled
def obstacle_costs(
    poses: NDArray[np.float32],
    x: float,
    y: float,
    costs: NDArray[np.uint8],
    frame: NDArray[np.float64],
    samples: NDArray[np.float64],
    check_from: int,
    stride: int,
    weight: float,
    near_goal: bool,
    total: NDArray[np.float64],
) -> int:
    """The cost critic: mean cost of the cells on the way; a collision costs all. Returns how many do not collide.

    Args:
        poses: Of ``rollout``.
        x: Of the start [m].
        y: Likewise.
        costs: Inflated, rows by columns.
        frame: Resolution, and x, y of the corner of cell (0, 0) [m].
        samples: Of the footprint.
        check_from: As in ``footprint_cost``.
        stride: Each how many steps a pose is looked at; the last one always is.
        weight: For a way along cells that cost 254.
        near_goal: Count collisions only: a goal may lie near a wall.
        total: Added to, one for each trajectory.
    """
    n, steps = poses.shape[0], poses.shape[1]
    free = 0
    for k in range(n):
        sum_ = 0.0
        looked = 0
        t = min(stride, steps) - 1
        hit = False
        while t < steps:
            cost = footprint_cost(
                costs,
                frame[0],
                frame[1],
                frame[2],
                x + poses[k, t, 0],
                y + poses[k, t, 1],
                poses[k, t, 2],
                poses[k, t, 3],
                samples,
                check_from,
            )
            if cost == _LETHAL:
                hit = True
                break
            sum_ += cost
            looked += 1
            if t < steps - 1 and t + stride > steps - 1:
                t = steps - 1
            else:
                t += stride
        if hit:
            # Later is better than sooner, if all collide.
            total[k] += _COLLISION * (2.0 - t / steps)
        else:
            free += 1
            if not near_goal:
                total[k] += weight * sum_ / (looked * _LETHAL)
    return free


@compiled
def furthest(poses: NDArray[np.float32], path: NDArray[np.float64]) -> int:
    """Index of the path's pose nearest to the end of the trajectory that comes furthest along it.

    Args:
        poses: Of ``rollout``.
        path: x, y from the start's [m], yaw [rad], n by 3.
    """
    result = 0
    last = poses.shape[1] - 1
    for k in range(poses.shape[0]):
        nearest, least = 0, np.inf
        for i in range(path.shape[0]):
            dx, dy = path[i, 0] - poses[k, last, 0], path[i, 1] - poses[k, last, 1]
            d = dx * dx + dy * dy
            if d < least:
                nearest, least = i, d
        result = max(result, nearest)
    return result


@compiled
def path_costs(
    controls: NDArray[np.float32],
    poses: NDArray[np.float32],
    path: NDArray[np.float64],
    valid: NDArray[np.bool_],
    aim: int,
    dt: float,
    spacing: float,
    stride: int,
    weights: NDArray[np.float64],
    total: NDArray[np.float64],
) -> None:
    """The critics path follow, path align and path angle.

    Args:
        controls: Of ``rollout``.
        poses: Likewise.
        path: x, y from the start's [m], yaw [rad], n by 3; evenly spaced, begins beside the robot.
        valid: Poses of the path that are not blocked: only to these trajectories are aligned.
        aim: Index of the pose to follow.
        dt: Of a step [s].
        spacing: Of the path [m].
        stride: Each how many steps a trajectory is compared with the path.
        weights: Follow [1/m], align [1/m], angle [1/rad].
        total: Added to, one for each trajectory.
    """
    n, steps, last = poses.shape[0], poses.shape[1], path.shape[0] - 1
    for k in range(n):
        cost = 0.0
        if weights[0] > 0:
            dx, dy = poses[k, steps - 1, 0] - path[aim, 0], poses[k, steps - 1, 1] - path[aim, 1]
            cost += weights[0] * np.sqrt(dx * dx + dy * dy)
        if weights[1] > 0:
            along, sum_, looked = 0.0, 0.0, 0
            for t in range(steps):
                along += abs(controls[0, k, t]) * dt
                if t % stride == stride - 1:
                    i = min(int(along / spacing + 0.5), last)
                    if valid[i]:
                        dx, dy = poses[k, t, 0] - path[i, 0], poses[k, t, 1] - path[i, 1]
                        sum_ += np.sqrt(dx * dx + dy * dy)
                        looked += 1
            if looked > 0:
                cost += weights[1] * sum_ / looked
        if weights[2] > 0:
            sum_ = 0.0
            looked = 0
            for t in range(stride - 1, steps, stride):
                dx, dy = path[aim, 0] - poses[k, t, 0], path[aim, 1] - poses[k, t, 1]
                c, s = poses[k, t, 2], poses[k, t, 3]
                sum_ += abs(np.arctan2(c * dy - s * dx, c * dx + s * dy))
                looked += 1
            cost += weights[2] * sum_ / max(looked, 1)
        total[k] += cost


@compiled
def motion_costs(
    planned: NDArray[np.float64],
    controls: NDArray[np.float32],
    poses: NDArray[np.float32],
    goal: NDArray[np.float64],
    dt: float,
    wheels: NDArray[np.float64],
    weights: NDArray[np.float64],
    pull: NDArray[np.float64],
    total: NDArray[np.float64],
) -> None:
    """The critics goal, goal angle, prefer forward and constraint, and MPPI's price of leaving the plan.

    Args:
        planned: As in ``rollout``.
        controls: Of ``rollout``.
        poses: Likewise.
        goal: x, y from the start's [m], yaw [rad].
        dt: Of a step [s].
        wheels: Half the distance between the wheels [m], their largest speed [m/s].
        weights: Goal [1/m], goal angle [1/rad], forward [1/m], constraint [1/m].
        pull: gamma over the variance of each velocity's noise.
        total: Added to, one for each trajectory.
    """
    n, steps = poses.shape[0], poses.shape[1]
    gc, gs = np.cos(goal[2]), np.sin(goal[2])
    for k in range(n):
        far, turned, back, beyond, left = 0.0, 0.0, 0.0, 0.0, 0.0
        for t in range(steps):
            v, w = controls[0, k, t], controls[1, k, t]
            if v < 0:
                back -= v
            over = abs(v) + abs(w) * wheels[0] - wheels[1]
            if over > 0:
                beyond += over
            left += pull[0] * planned[0, t] * (v - planned[0, t]) + pull[1] * planned[1, t] * (w - planned[1, t])
            if weights[0] > 0:
                dx, dy = poses[k, t, 0] - goal[0], poses[k, t, 1] - goal[1]
                far += np.sqrt(dx * dx + dy * dy)
            if weights[1] > 0:
                c, s = poses[k, t, 2], poses[k, t, 3]
                turned += abs(np.arctan2(gc * s - gs * c, gc * c + gs * s))
        total[k] += weights[0] * far / steps + weights[1] * turned / steps
        total[k] += (weights[2] * back + weights[3] * beyond) * dt + left


@compiled
def weighted_mean(
    controls: NDArray[np.float32], total: NDArray[np.float64], temperature: float, mean: NDArray[np.float64]
) -> None:
    """Mean velocities, each trajectory with the weight exp(-(cost - least) / temperature).

    Args:
        controls: Of ``rollout``.
        total: Cost of each trajectory.
        temperature: Of the same unit.
        mean: Out: 2 by steps.
    """
    n, steps = controls.shape[1], controls.shape[2]
    least = total.min()
    mean[:] = 0.0
    weights = 0.0
    for k in range(n):
        weight = np.exp((least - total[k]) / temperature)
        # What is left out has less than a thousandth of the whole, with 10,000 trajectories.
        if weight > 1e-7:
            weights += weight
            for t in range(steps):
                mean[0, t] += weight * controls[0, k, t]
                mean[1, t] += weight * controls[1, k, t]
    mean /= weights
