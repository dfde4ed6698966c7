"""The loop of navigation, without topics and clocks: sensors and goals go in, each step gives a velocity.

Whatever is wrong (no map, no scans, a robot that was carried away) the robot stands, says why, and goes on by itself.
Only while it knows where it is, the behaviour tree is asked what to do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from py_trees.common import Status as TreeStatus

from skytether.control.admittance import STANDSTILL, Velocity
from skytether_services.planar.geometry import Pose, advance

from .behaviour_tree import BUILT_IN, load_tree
from .checkers import GoalChecker, ProgressChecker
from .controller import Controller, ControlStatus, FollowedPath, turn_towards
from .costmap import INSCRIBED, LETHAL, Costmap
from .dwa import Dwa
from .footprint import FootprintChecks, cost_at
from .grid_map import GridMap
from .mppi import Mppi
from .params import ControllerName, Params
from .planner import PlanStatus, plan
from .prediction import PredictedState, State
from .shared_word import Said
from .status import Code, Trouble
from .status import State as Doing
from .surroundings import Surroundings
from .task import Task, refusal
from .whereabouts import Whereabouts
from .zones import Mask

_LEGS = 3
"""Goals that are driven through are planned so many at a time."""
_BEND = 0.3
"""The direction of a path is that of a piece so long [m]."""
_LOOK = 2.5
"""So much of the path is watched for what stands on it [m]."""


@dataclass(frozen=True)
class Report:
    """What the service tells of itself.

    Attributes:
        doing: What the robot does.
        trouble: Why it stands, or gave up; None: nothing is wrong.
        message: A sentence.
        task: What it was asked to do last; None: nothing yet.
        behaviour: The leaf of the tree that is at work.
        recoveries: On the way to the present goal.
        left: Way to the present goal along the path [m]; NaN: not known.
    """

    doing: Doing
    trouble: Trouble | None
    message: str
    task: Task | None
    behaviour: str
    recoveries: int
    left: float

    @property
    def code(self) -> str:
        """For programs."""
        return str(self.trouble.code) if self.trouble is not None else str(Code.OK)


class Navigator:
    """Of one robot. The behaviour tree's leaves act on it (`behaviours.Robot`)."""

    def __init__(self, params: Params) -> None:
        """Begin without a map and without goals.

        Raises:
            ConfigError: The behaviour tree is wrong.
            ValueError: The footprint is.
        """
        self._params = params
        self._footprint = params.footprint.footprint
        random, for_controller = (np.random.default_rng((params.seed, i)) for i in (0, 1))
        self.whereabouts = Whereabouts(params.sensors, params.localisation, params.limits, random)
        self.surroundings: Surroundings | None = None
        self.no_map: Trouble | None = None
        self._controller = self._make_controller(for_controller)
        self._predicted = PredictedState(params.delay)
        self._checks = FootprintChecks(self._footprint, params.inflation, params.planner.margin)
        self._goals = GoalChecker(params.goal)
        self._progress = ProgressChecker(params.progress)
        path = Path(params.behaviours) if params.behaviours else BUILT_IN
        self._tree = load_tree(path, self, 1 / params.rates.planner)
        self.now = 0.0
        self.requests = 0
        """How often somebody gave goals, or tried to."""
        self._state = self._arrival = State(Pose(0.0, 0.0, 0.0), STANDSTILL, 0.0)
        self._command = STANDSTILL
        self._task: Task | None = None
        self._checked = False
        self._paused = False
        self._doing = Doing.WAITING
        self._trouble: Trouble | None = None
        self._hopeless: Trouble | None = None
        self._recoveries = 0
        self.path: NDArray[np.float64] = np.empty((0, 3))
        self._followed: FollowedPath | None = None
        self._aim: Pose | None = None
        self._planned_at = -math.inf
        self._no_way = False
        self._on_own = False
        """The path leads where other robots say that there is no way: there was no other."""
        self.trajectory: NDArray[np.float64] = np.empty((0, 3))

    def _make_controller(self, random: np.random.Generator) -> Controller:
        params, period = self._params, 1 / self._params.rates.control
        if params.controller is ControllerName.DWA:
            dwa = replace(params.dwa, period=period)
            return Dwa(self._footprint, params.limits, params.inflation, dwa)
        mppi = replace(params.mppi, period=period)
        return Mppi(self._footprint, params.limits, params.inflation, random, mppi)

    # What people and programs ask for.

    def use_map(self, grid: GridMap, keep_out: Mask | None = None, speed: Mask | None = None) -> None:
        """Drive on this map from now on.

        Raises:
            ValueError: It cannot be driven on; the text says why.
        """
        self.surroundings = Surroundings(grid, self._params, self._footprint, keep_out, speed)
        self.whereabouts.use_map(grid)
        self.no_map = None
        self._checked = False
        self._forget_path()

    def place(self, pose: Pose, deviation: float = 0.0, turn: float = 0.0) -> None:
        """Somebody says where the robot is (`Whereabouts.place`)."""
        self.whereabouts.place(pose, deviation, turn)
        self._forget_path()

    def go(self, goals: Sequence[Pose], *, rounds: int = 1, stop_at_each: bool = True) -> None:
        """Go there, whatever the robot does now. A list that cannot be one is told as failed, and the robot stands."""
        self.requests += 1
        self._paused = False
        wrong = refusal(goals)
        if wrong is not None:
            self._end(Doing.FAILED, wrong)
            return
        self._begin(Task(tuple(goals), rounds, stop_at_each))
        self._checked = False

    def cancel(self) -> bool:
        """Stand, and forget the goals; false: there were none."""
        if not self.is_busy:
            return False
        self._paused = False
        self._end(Doing.CANCELED, None)
        return True

    def pause(self, paused: bool) -> bool:
        """Stand until told to go on; false: there is nothing to pause."""
        if not self.is_busy:
            return False
        self._paused = paused
        return True

    def refuse(self, trouble: Trouble) -> None:
        """A request could not even be read: the robot stands, and says so."""
        self.requests += 1
        self._paused = False
        self._end(Doing.FAILED, trouble)

    @property
    def is_busy(self) -> bool:
        """Whether there are goals to go to."""
        return self._doing in (Doing.DRIVING, Doing.STANDING, Doing.PAUSED)

    # The loop.

    @property
    def _asked(self) -> Task:
        """The task, where there is one: while the tree is asked."""
        assert self._task is not None  # noqa: S101
        return self._task

    @property
    def _around(self) -> Surroundings:
        """Likewise."""
        assert self.surroundings is not None  # noqa: S101
        return self.surroundings

    def step(self, now: float, delay: float) -> Velocity:
        """The velocity to command now.

        Args:
            now: [s].
            delay: How long a command takes to the robot at present [s].
        """
        self.now = now
        self._command = STANDSTILL
        if self.surroundings is not None:
            self.surroundings.neighbours.read(now)
        sighting = self.whereabouts.match_scan(now)
        state = self.whereabouts.state()
        trouble = self.no_map or self.whereabouts.trouble(now)
        if state is not None and self.surroundings is not None and trouble is None:
            self._state = state
            self._arrival = self._predicted.at_arrival(state, now, delay)
            self.surroundings.update(now, state.pose, sighting)
        if self.is_busy:
            if self._paused:
                self._stand(Doing.PAUSED, None)
            elif trouble is not None:
                self._stand(Doing.STANDING, trouble)
            else:
                self._drive()
        elif self._doing is Doing.WAITING:
            self._trouble = trouble
        self._predicted.sent(self._command, now, delay)
        return self._command

    def _stand(self, doing: Doing, trouble: Trouble | None) -> None:
        self._doing, self._trouble = doing, trouble
        self._controller.reset()
        self._progress.reset()
        self._no_way = False

    def _drive(self) -> None:
        """Ask the tree."""
        if self._doing is not Doing.DRIVING:
            self._doing, self._trouble = Doing.DRIVING, None
        if not self._checked:
            self._checked = True
            wrong = self._unreachable()
            if wrong is not None:
                self._end(Doing.FAILED, wrong)
                return
        self._tree.tick_once()
        if self._hopeless is not None:
            self._given_up(self._hopeless)
        elif self._tree.status == TreeStatus.SUCCESS:
            self._reached()
        elif self._tree.status == TreeStatus.FAILURE:
            self._given_up(self._trouble or Trouble(Code.GAVE_UP, "The behaviour tree gave the goal up."))

    def _unreachable(self) -> Trouble | None:
        """Why a goal of the list can never be reached, as the map alone tells."""
        for number, goal in enumerate(self._asked.goals, 1):
            code = self._around.refusal(goal, self._params.planner.tolerance)
            if code is not None and not (self._params.skip_unreachable and len(self._asked.goals) > 1):
                where = "is not on the map" if code is Code.GOAL_OFF_MAP else "is in a wall, or too near to one"
                return Trouble(code, f"Goal {number} at ({goal.x:.2f}, {goal.y:.2f}) {where}.")
        return None

    def _begin(self, task: Task) -> None:
        self._task = task
        self._doing, self._trouble = Doing.DRIVING, None
        self._start_over()

    def _start_over(self) -> None:
        """For another goal. The controller keeps its plan: a robot that is moving goes on moving."""
        self._tree.stop(TreeStatus.INVALID)
        self._planned_at = -math.inf
        self._hopeless = None
        self._recoveries = 0
        self._goals.reset()
        self._progress.reset()
        self._no_way = False

    def _end(self, doing: Doing, trouble: Trouble | None) -> None:
        self._start_over()
        self._forget_path()
        self._command = STANDSTILL
        self._doing, self._trouble = doing, trouble

    def _forget_path(self) -> None:
        self._controller.set_path(np.empty((0, 3)))
        self._controller.reset()
        self.path = self.trajectory = np.empty((0, 3))
        self._followed = self._aim = None
        self._planned_at = -math.inf

    def _reached(self) -> None:
        following = self._asked.following()
        if following is None:
            self._end(Doing.SUCCEEDED, None)
        else:
            self._begin(following)

    def _given_up(self, why: Trouble) -> None:
        following = self._asked.following() if self._params.skip_unreachable else None
        if following is None:
            self._end(Doing.FAILED, why)
        else:
            self._begin(following)

    @property
    def predicted(self) -> tuple[State, State]:
        """The robot as it was seen last, and as it is to be when the newest command arrives."""
        return self._state, self._arrival

    # What the leaves of the tree do (behaviours.Robot).

    @property
    def pose(self) -> Pose:
        return self._state.pose

    @property
    def plan_age(self) -> float:
        return self.now - self._planned_at

    @property
    def is_blocked(self) -> bool:
        return self._no_way or self._is_path_blocked()

    def _is_path_blocked(self) -> bool:
        whole = None
        if self.surroundings is not None:
            whole = self.surroundings.own if self._on_own else self.surroundings.whole
        if self._followed is None or whole is None:
            return False
        ahead = self._followed.ahead(self.pose.x, self.pose.y, _LOOK, whole.resolution)
        # Where the robot stands the path may touch what is near: the controller knows.
        return any(whole.at(x, y) in (INSCRIBED, LETHAL) for x, y, _ in ahead[4:])

    def plan(self) -> Trouble | None:
        whole, own = self._around.whole, self._around.own
        if whole is None or own is None:
            return Trouble(Code.NO_MAP, "The costmap is not ready yet.")
        trouble = self._plan_on(whole)
        self._on_own = trouble is not None and own is not whole and self._hopeless is None
        # What others say makes no goal unreachable: where they leave no way, the robot goes and looks for itself.
        return self._plan_on(own) if self._on_own else trouble

    def _plan_on(self, whole: Costmap) -> Trouble | None:
        start = self.pose
        pieces: list[NDArray[np.float64]] = []
        for goal in self._asked.until_stop(_LEGS):
            found = plan(whole, start, goal, self._params.planner, self._checks)
            if found.status is not PlanStatus.FOUND or found.goal is None:
                if pieces:
                    break  # the goals after the present one can wait
                trouble = Trouble(Code(found.status.value), found.message)
                known = plan(self._around.known, start, goal, self._params.planner)
                if known.status in (PlanStatus.NO_PATH, PlanStatus.GOAL_BLOCKED, PlanStatus.GOAL_OFF_MAP):
                    self._hopeless = trouble
                return trouble
            if pieces and _turns_back(pieces[-1], found.path):
                break  # controllers are drawn to the path's end: they would cut the corner, or not know which way to go
            pieces.append(found.path)
            if len(pieces) == 1:
                self._aim = found.goal
            start = found.goal
        self._planned_at = self.now
        self._no_way = False
        self.path = np.concatenate(pieces)
        self._controller.set_path(self.path)
        self._followed = FollowedPath(self.path)
        return None

    def follow(self) -> bool:
        near, state = self._around.near, self._arrival
        if near is None or self._aim is None:
            return False
        if self._asked.stops:
            reached = self._goals.reached(self.pose, self._state.velocity, self._aim)
        else:
            reached = math.dist(self.pose[:2], self._aim[:2]) <= self._params.pass_within
        if reached and self._asked.stops:
            return True
        limit = self._around.speed_limit(self.pose)
        control = self._controller.control(state.pose, state.velocity, near, speed_limit=limit)
        self._no_way = control.status is not ControlStatus.DRIVING
        if not self._no_way:
            self._trouble = None
        self.trajectory = control.trajectory
        self._command = control.velocity
        return reached

    def is_stuck(self) -> bool:
        return self._progress.stuck(self.pose, self.now)

    def clear(self, *, whole: bool, near: bool) -> None:
        if self.surroundings is not None:
            self.surroundings.clear(whole=whole, near=near)

    def creep(self, velocity: Velocity, ahead: float) -> bool:
        near = self.surroundings.near if self.surroundings is not None else None
        if near is None:
            return False
        for part in (0.25, 0.5, 0.75, 1.0):
            pose = advance(self._arrival.pose, velocity.linear, velocity.angular, part * ahead)
            if cost_at(near, self._footprint, pose) == LETHAL:
                return False
        self._command = velocity
        return True

    def turn_rate(self, left: float, most: float) -> float:
        limits = self._params.limits
        limits = replace(limits, max_angular=min(limits.max_angular, most))
        return turn_towards(left, self._arrival.velocity.angular, limits, 1 / self._params.rates.control)

    def blame(self, trouble: Trouble) -> None:
        self._trouble = trouble

    def recovered(self) -> None:
        self._recoveries += 1
        self._progress.reset()
        self._planned_at = -math.inf

    def receive(self, now: float, said: Sequence[Said]) -> None:
        """Other robots of the group said something (`neighbours`)."""
        if self.surroundings is not None:
            self.surroundings.neighbours.receive(now, said)

    def word(self, now: float) -> str | None:
        """What to tell them; None: there are none, or this robot does not know where it is."""
        state = self.whereabouts.state()
        if self.surroundings is None or state is None or self.whereabouts.trouble(now) is not None:
            return None
        return self.surroundings.word(now, state.pose)

    def report(self) -> Report:
        """What to tell."""
        tip = self._tree.tip() if self._doing is Doing.DRIVING else None
        left = self._followed.left() if self._followed is not None else math.nan
        message = self._trouble.message if self._trouble is not None else _SENTENCES[self._doing]
        return Report(self._doing, self._trouble, message, self._task, tip.name if tip else "", self._recoveries, left)


def _turns_back(before: NDArray[np.float64], after: NDArray[np.float64]) -> bool:
    """Whether the robot has to turn by more than a right angle between two paths, n by 3."""
    arrives = before[-1, :2] - before[np.hypot(*(before[:, :2] - before[-1, :2]).T) > _BEND][-1:, :2]
    leaves = after[np.hypot(*(after[:, :2] - after[0, :2]).T) > _BEND][:1, :2] - after[0, :2]
    return bool(arrives.size and leaves.size and float((arrives @ leaves.T).item()) < 0.0)


_SENTENCES = {
    Doing.WAITING: "There is no goal yet.",
    Doing.DRIVING: "The robot is on its way.",
    Doing.STANDING: "The robot stands.",
    Doing.PAUSED: "The robot was told to wait.",
    Doing.SUCCEEDED: "The last goal was reached.",
    Doing.FAILED: "The goals were given up.",
    Doing.CANCELED: "The goals were called off.",
}
