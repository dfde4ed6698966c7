"""Where a laser was at each scan of a drive through an unknown building: matching, loops, and a graph of poses.

Three steps. `_follow` matches scan after scan against a patch of map of the last keyframes. Loops are looked for as it
goes on: what keyframes saw around themselves, against the patches of earlier ones near by. At the end each keyframe is
matched once more against all passes near it, and the graph of all these motions is solved.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .patch import REACH, Patch, make_patch
from .pose_graph import Edges, optimise
from .poses import between, compose, wrap
from .scan_following import match_next, odometry_information, turned
from .scan_matching import Fit, moved, rate, refine, scan_points, search, thin

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class MappingParams:
    """Settings of mapping.

    Attributes:
        usable_range: Points farther off are left out: a small error of the heading moves them far [m].
        keyframe_m: A scan is kept as keyframe when the laser has moved so far [m].
        keyframe_rad: Or has turned so far [rad].
        window: Keyframes, back from the newest, that the next scan is matched against.
        odometry_m: Error of the odometry's motion, for each metre [m/m].
        odometry_rad: Error of its turn, for each radian [rad/rad].
        loop_every: Every so many keyframes a loop is looked for.
        loop_travel: Keyframes with less travel between them are no loop [m].
        loop_reach: Drift for each metre of travel, within which a loop is looked for [m/m].
        loop_most: The same, at most [m].
        loop_score: Least part of the points that have to fit.
        passes: How often all keyframes are matched anew at the end.
    """

    usable_range: float = 30.0
    keyframe_m: float = 0.2
    keyframe_rad: float = 0.15
    window: int = 15
    odometry_m: float = 0.1
    odometry_rad: float = 0.1
    loop_every: int = 4
    loop_travel: float = 6.0
    loop_reach: float = 0.03
    loop_most: float = 5.0
    loop_score: float = 0.6
    passes: int = 2


_INDEPENDENT = 0.02
"""Part of a scan's points that err independently of their neighbours."""
_FLOOR = np.diag([0.01**2, 0.01**2, 0.003**2])
"""Covariance of a perfect match, in m², m², rad²: the map between two keyframes bends by so much."""
_AROUND = 6
"""Keyframes to each side that see one another's surroundings, for loops."""
_NARROW = 4
"""Cells around a surface that know it, in the matches at the end, which begin near: 0.2 m."""
_MOVE_M, _MOVE_RAD = 0.5, 0.15
"""A match at the end may not move a keyframe farther than this."""


@dataclass
class _Graph:
    """Keyframes and the motions between them, as they grow."""

    points: list[Floats] = field(default_factory=list)
    poses: list[Floats] = field(default_factory=list)
    travel: list[float] = field(default_factory=list)
    scan: list[int] = field(default_factory=list)
    pairs: list[tuple[int, int]] = field(default_factory=list)
    motions: list[Floats] = field(default_factory=list)
    information: list[Floats] = field(default_factory=list)
    loops: list[bool] = field(default_factory=list)

    def add(self, first: int, second: int, pose_first: Floats, fit: Fit, loop: bool) -> None:
        self.pairs.append((first, second))
        self.motions.append(between(pose_first, fit.pose))
        self.information.append(turned(_damped(fit.information), pose_first[2]))
        self.loops.append(loop)

    def edges(self) -> Edges:
        return Edges(
            np.array(self.pairs), np.array(self.motions), np.array(self.information), np.array(self.loops, dtype=bool)
        )

    def solve(self) -> Floats:
        """Moves the poses; returns the edges' errors."""
        if len(self.poses) < 2:
            return np.zeros(0)
        poses, errors = optimise(np.array(self.poses), self.edges())
        self.poses = list(poses)
        return errors

    def copy(self) -> _Graph:
        """One that can grow on its own; what it has is never changed in place."""
        return _Graph(
            list(self.points),
            list(self.poses),
            list(self.travel),
            list(self.scan),
            list(self.pairs),
            list(self.motions),
            list(self.information),
            list(self.loops),
        )

    def patch(self, keys: range, reach: int = REACH) -> Patch:
        return make_patch(np.vstack([moved(self.points[k], self.poses[k]) for k in keys]), reach)


@dataclass(frozen=True)
class Trajectory:
    """What mapping found.

    Attributes:
        poses: Of the laser at each scan, n by (x [m], y [m], theta [rad]); the first is the origin.
        keyframes: Numbers of the scans that are in the graph.
        loops: Number of motions in the graph that close a loop.
    """

    poses: Floats
    keyframes: NDArray[np.int64]
    loops: int


class Mapper:
    """Takes the scans of a drive one by one.

    Attributes:
        pose: Of the laser at the last scan, as far as it is known so far.
        loops: Number of motions in the graph that close a loop, so far.
    """

    def __init__(self, params: MappingParams | None = None, start: Floats | None = None) -> None:
        """Begin with the laser at ``start``, x [m], y [m], theta [rad]; None: at the origin."""
        self._params = params or MappingParams()
        self._graph = _Graph()
        self._raw: list[Floats] = []  # as the front end saw it, relative to the keyframe before
        self._owner: list[int] = []
        self._velocity = np.zeros(3)
        self._patch: Patch | None = None
        self._looked = 0
        self._stamp = 0.0
        self._odometry: Floats | None = None
        self.pose = np.zeros(3) if start is None else start
        self.loops = 0

    @property
    def keyframes(self) -> int:
        """How many scans are in the graph."""
        return len(self._graph.poses)

    @property
    def travel(self) -> float:
        """Way from keyframe to keyframe [m]."""
        return self._graph.travel[-1] if self._graph.travel else 0.0

    def add(
        self, stamp: float, ranges: NDArray[np.float32], angles: Floats, max_range: float, odometry: Floats | None
    ) -> bool:
        """Take the next scan; returns whether it became a keyframe.

        Args:
            stamp: [s].
            ranges: [m].
            angles: Of the rays [rad].
            max_range: Ranges from here on, and NaN, met nothing [m].
            odometry: Pose of the robot at the scan; None, for all scans: from the laser alone.
        """
        params, graph = self._params, self._graph
        points = scan_points(ranges, angles, min(max_range, params.usable_range))
        first = not self._raw
        dt = 0.0 if first else stamp - self._stamp
        motion = self._velocity * dt
        if odometry is not None and self._odometry is not None:
            motion = between(self._odometry, odometry)
        self._stamp, self._odometry = stamp, odometry
        if self._patch is None:
            fit = Fit(compose(self.pose, motion), np.zeros((3, 3)), 1.0, 0.0)
        else:
            fit = _follow(self._patch, points, self.pose, motion, dt, odometry is not None, params)
        if dt > 1e-3 and odometry is None:
            self._velocity = np.clip(between(self.pose, fit.pose) / dt, [-2, -2, -2], [2, 2, 2])
        self.pose = fit.pose
        new = self._is_new(points)
        if new:
            self._keep(len(self._raw), points, fit)
        self._owner.append(max(len(graph.poses) - 1, 0))
        self._raw.append(between(graph.poses[-1], self.pose) if graph.poses else self.pose)
        return new

    def _is_new(self, points: Floats) -> bool:
        """Whether a scan from here becomes a keyframe."""
        if len(points) < 10:
            return False
        if not self._graph.poses:
            return True
        since = between(self._graph.poses[-1], self.pose)
        return bool(np.hypot(since[0], since[1]) > self._params.keyframe_m or abs(since[2]) > self._params.keyframe_rad)

    def _keep(self, number: int, points: Floats, fit: Fit) -> None:
        params, graph = self._params, self._graph
        last = len(graph.poses) - 1
        since = between(graph.poses[-1], self.pose) if last >= 0 else np.zeros(3)
        graph.points.append(thin(points, 0.05))
        graph.travel.append(graph.travel[-1] + float(np.hypot(since[0], since[1])) if last >= 0 else 0.0)
        graph.scan.append(number)
        graph.poses.append(self.pose)
        if last >= 0:
            graph.add(last, last + 1, graph.poses[last], _held(fit, _by_odometry(since, params)), False)
        if last + 1 - self._looked >= 20:
            self._looked = last + 1
            found = _close_loops(graph, self._looked - 20 - _AROUND, self._looked - _AROUND, params)
            if found:
                graph.solve()
                self.pose = graph.poses[-1]
                self.loops += found
        self._patch = graph.patch(range(max(0, len(graph.poses) - params.window), len(graph.poses)))

    def finished(self, passes: int | None = None, progress: Callable[[str], None] = lambda _: None) -> Trajectory:
        """The poses of all scans so far, at their best; more scans can come afterwards.

        Args:
            passes: How often all keyframes are matched anew; None: as the parameters say.
            progress: Told now and then how far it is.
        """
        params, graph = self._params, self._graph.copy()
        passes = params.passes if passes is None else passes
        _close_loops(graph, self._looked - _AROUND, len(graph.poses), params)
        graph.solve()
        for turn in range(passes):
            progress(f"all {len(graph.poses)} keyframes once more: {turn + 1} of {passes}")
            graph = _matched_anew(graph, params)
            graph.solve()
        raw = np.array(self._raw).reshape(-1, 3)
        poses = _all_poses(graph, raw, np.array(self._owner, dtype=np.int64))
        return Trajectory(poses, np.array(graph.scan, dtype=np.int64), sum(graph.loops))


def find_trajectory(
    stamps: Floats,
    ranges: NDArray[np.float32],
    angles: Floats,
    max_range: float,
    odometry: Floats | None,
    params: MappingParams | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Trajectory:
    """Poses of the laser at all scans of a drive.

    Args:
        stamps: Of the scans, n [s].
        ranges: n by rays [m].
        angles: Of the rays [rad].
        max_range: Ranges from here on, and NaN, met nothing [m].
        odometry: Pose of the robot at each scan, n by 3; None: from the laser alone.
        params: Settings.
        progress: Told now and then how far it is.
    """
    mapper = Mapper(params)
    for i in range(len(stamps)):
        loops = mapper.loops
        mapper.add(stamps[i], ranges[i], angles, max_range, None if odometry is None else odometry[i])
        if mapper.loops != loops:
            progress(f"scan {i + 1} of {len(stamps)}, {mapper.loops} loops")
    return mapper.finished(progress=progress)


def _follow(
    patch: Patch, points: Floats, pose: Floats, motion: Floats, dt: float, measured: bool, params: MappingParams
) -> Fit:
    """Match the next scan by what is known of its motion: by odometry, or by the velocity before."""
    if not measured:
        by_velocity = np.diag([0.1**-2, 0.1**-2, 0.2**-2])
        reach = (min(0.1 + 0.6 * dt, 0.5), min(0.1 + 1.5 * dt, 0.6))
        return match_next(patch, points, pose, motion, by_velocity, reach, None)
    reach = (0.1 + 0.5 * float(np.hypot(motion[0], motion[1])), 0.05 + 0.5 * abs(float(motion[2])))
    return match_next(patch, points, pose, motion, _by_odometry(motion, params), reach, 0.5)


def _close_loops(graph: _Graph, first: int, last: int, params: MappingParams) -> int:
    """Look for loops at the keyframes from first up to last; returns how many there were."""
    found = 0
    poses, travel = np.array(graph.poses), np.array(graph.travel)
    for k in range(max(first, 0), last):
        if k % params.loop_every:
            continue
        keys = range(max(0, k - _AROUND), min(len(graph.poses), k + _AROUND + 1))
        seen = np.vstack([_of(graph, key, k) for key in keys])
        seen = thin(seen, 0.1)
        for j in _near(poses, travel, k, params.loop_reach * (travel[k] - travel) + 0.5, params, most=params.loop_most)[
            :2
        ]:
            gap = travel[k] - travel[j]
            reach = min(0.5 + params.loop_reach * gap, params.loop_most)
            target = graph.patch(range(max(0, j - _AROUND - 4), min(j + _AROUND + 5, k - _AROUND)))
            pose, score = search(target, seen, graph.poses[k], reach, min(0.1 + 0.003 * gap, 0.5), params.loop_score)
            if score <= 0:
                continue
            fit = refine(target, seen, pose)
            if rate(target, seen, fit.pose) >= params.loop_score and fit.overlap > 0.5:
                graph.add(j, k, graph.poses[j], fit, True)
                found += 1
    return found


def _of(graph: _Graph, key: int, k: int) -> Floats:
    """The points of a keyframe in the frame of another."""
    return moved(graph.points[key], between(graph.poses[k], graph.poses[key]))


def _near(
    poses: Floats,
    travel: Floats,
    k: int,
    reach: Floats | float,
    params: MappingParams,
    most: float,
    ahead: bool = False,
) -> list[int]:
    """Keyframes of other passes near keyframe k, the nearest of each pass, nearest first."""
    away = np.hypot(poses[:, 0] - poses[k, 0], poses[:, 1] - poses[k, 1])
    gap = travel[k] - travel
    apart = (np.abs(gap) if ahead else gap) > params.loop_travel
    candidates = np.flatnonzero(apart & (away <= np.minimum(reach, most)))
    chosen: list[int] = []
    for j in candidates[np.argsort(away[candidates])].tolist():
        if all(abs(travel[j] - travel[other]) > params.loop_travel / 2 for other in chosen):
            chosen.append(j)
    return chosen


def _matched_anew(graph: _Graph, params: MappingParams) -> _Graph:
    """The same keyframes, each matched against the one before it and against the other passes near it."""
    result = _Graph(graph.points, list(graph.poses), graph.travel, graph.scan)
    seen = {pair: n for n, pair in enumerate(graph.pairs)}
    poses, travel = np.array(graph.poses), np.array(graph.travel)
    for k in range(1, len(graph.poses)):
        points, pose = graph.points[k], graph.poses[k]
        before = seen[(k - 1, k)]
        prior = _by_odometry(graph.motions[before], params)
        guess = compose(graph.poses[k - 1], graph.motions[before])
        target = graph.patch(range(max(0, k - params.window), k), _NARROW)
        fit = refine(target, points, pose, np.zeros((3, 3)))
        if fit.overlap < 0.3 or not _close(fit.pose, pose):
            fit = Fit(guess, np.zeros((3, 3)), 0.0, 0.0)
        result.add(k - 1, k, graph.poses[k - 1], _held(fit, prior), False)
        for j in _near(poses, travel, k, 4.0, params, most=4.0, ahead=True)[:3]:
            low, high = max(0, j - _AROUND), min(j + _AROUND + 1, len(graph.poses))
            fit = refine(graph.patch(range(low, high), _NARROW), points, pose)
            if fit.overlap >= 0.5 and _close(fit.pose, pose):
                result.add(j, k, graph.poses[j], fit, True)
    return result


def _close(a: Floats, b: Floats) -> bool:
    return bool(np.hypot(a[0] - b[0], a[1] - b[1]) < _MOVE_M and abs(wrap(a[2] - b[2])) < _MOVE_RAD)


def _held(fit: Fit, odometry: Floats) -> Fit:
    """The fit, never weaker than the odometry's motion."""
    return Fit(fit.pose, fit.information + odometry / _INDEPENDENT, fit.overlap, fit.residual)


def _by_odometry(motion: Floats, params: MappingParams) -> Floats:
    return odometry_information(motion, params.odometry_m, params.odometry_rad)


def _damped(information: Floats) -> Floats:
    """The information of a match of points that do not err independently, on a map that bends."""
    loose = information * _INDEPENDENT + np.diag([1e-3, 1e-3, 1e-3])
    return np.linalg.inv(np.linalg.inv(loose) + _FLOOR)


def _all_poses(graph: _Graph, raw: Floats, owner: NDArray[np.int64]) -> Floats:
    """Poses of all scans, each as it was seen from the keyframe before it."""
    return compose(np.array(graph.poses)[owner], raw) if graph.poses else raw
