"""The navigation experiment of the thesis (Mello, sections 4.3.5 and 5.6.2): nine goals in a building, over a network.

A simulated robot asks an orchestrator for the service ``navigation``, gives it the building's map and is driven to nine
goals, one after the other. Between the first and the second a person steps into its way. What is around robot and
service is of `skytether.lab.trial`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from skytether.messages import Path, decode
from skytether.robot.control.supervisor import VelocityLimits

from .nine_goals_result import NineGoalsResult, NineGoalsTraces
from .trial.results import Measured, Point, rounded
from .trial.rig import Rig, Status, Task
from .trial.scenario import ROBOT_CPU, Scenario, TrialSettings
from .trial.tracker import Tracker
from .world.occupancy import Occupancy
from .world.plan import Plan, building
from .world.simulation import Simulation

ROBOT, SERVICE = "pioneer", "navigation"
_BEAT_S = 2.0
"""The map is given again so long after a service said that it has none."""
LIMITS = VelocityLimits(linear_max=0.5, linear_min=-0.1, angular_max=1.0)
"""What the simulated robot can do."""

_EMBEDDED_RATES = {
    "control": 6.0,
    "planner": 0.4,
    "local_costmap": 4.0,
    "publish_local_costmap": 0.5,
    "global_costmap": 1.0,
    "publish_global_costmap": 0.4,
}
"""Table 5 of the thesis, for processing on the robot."""
SCENARIOS: Mapping[str, Scenario] = MappingProxyType(
    {
        scenario.name: scenario
        for scenario in (
            Scenario("embedded", params={"rates": _EMBEDDED_RATES}, cpu=ROBOT_CPU),
            Scenario("edge", 0.0287, 0.0209, 0.005),
            Scenario("commercial", 0.1522, 0.0247, 0.001),
            Scenario("private", 0.1962, 0.0241, 0.027),
        )
    }
)
"""Round trips, deviations and losses that section 5.6.3 measured with ping."""


@dataclass(frozen=True, slots=True)
class NineGoalsSettings(TrialSettings):
    """One trial.

    Attributes:
        goals: Drive to the first so many.
    """

    goals: int = 9

    def document(self) -> dict[str, Any]:
        return {**TrialSettings.document(self), "goals": self.goals}


class _Notes:
    """For figures, beside the rig's: when goals were reached, what was planned around the person, where that was."""

    def __init__(self, world: Simulation) -> None:
        self._world = world
        self._goals: list[int] = []
        self._person: list[Point] = []
        self._plans: list[tuple[Point, ...]] = []

    def sample(self, now: float, reached: int, tracker: Tracker) -> None:
        """Take what is due.

        Args:
            now: [s], not less than before.
            reached: Goals so far.
            tracker: The rig's.
        """
        at = len(tracker.way)
        if tracker.sample(now):
            self._goals += [at] * (reached - len(self._goals))
            for stance in self._world.stances[:1]:
                if self._person[-1:] != [place := rounded(stance.trunk)]:
                    self._person.append(place)

    def plan(self, payload: bytes | memoryview) -> None:
        """A path that the service plans: those around the person are kept, each fourth point and the last."""
        if len(self._goals) == 1:
            poses = decode(Path, payload, "cdr").poses
            points = [rounded((one.pose.position.x, one.pose.position.y)) for one in poses]
            self._plans.append((*points[:-1:4], *points[-1:]))

    def traces(self, reached: int, tracker: Tracker) -> NineGoalsTraces:
        """All of it."""
        goals = (*self._goals, *[len(tracker.way) - 1] * (reached - len(self._goals)))
        return NineGoalsTraces(**tracker.traces(), goals=goals, person=tuple(self._person), plans=tuple(self._plans))


class NineGoalsTrial:
    """One run. A context manager, as its `Rig` is."""

    def __init__(self, settings: NineGoalsSettings, plan: Plan | None = None) -> None:
        self.settings = settings
        self.plan = plan or building()
        self.world = Simulation(self.plan, seed=settings.seed)
        self.rig = Rig(settings, Task(SERVICE, self._params(), ROBOT, LIMITS), self.world, self._on_status)
        self._notes = _Notes(self.world)
        self._mapped_at = -math.inf
        self._reached: dict[int, float] = {}
        self._stack = ExitStack()

    def __enter__(self) -> NineGoalsTrial:
        with ExitStack() as stack:
            stack.callback(self.rig.graph.subscribe("plan", self._notes.plan))
            stack.enter_context(self.rig)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def drive(self, on_progress: Callable[[Status], None] = lambda _: None) -> NineGoalsResult:
        """Wait until the last goal is reached, given up, or the time is over.

        Args:
            on_progress: Told the service's status, some twenty times a second.

        Raises:
            TrialError: The service did not drive in time.
        """
        with self.rig.driving() as drive:
            for now in drive.passes():
                if self.rig.status.get("state") in ("succeeded", "failed"):
                    break
                self._notes.sample(now, self._goals_reached(), drive.tracker)
                on_progress(self.rig.status)
            return self._result(drive.measured(), drive.tracker)

    def _result(self, measured: Measured, tracker: Tracker) -> NineGoalsResult:
        status = self.rig.status
        succeeded = status.get("state") == "succeeded"
        return NineGoalsResult(
            **measured.shared(),
            completed=succeeded and not measured.contacts,
            goals=self.settings.goals if succeeded else max(0, status.get("goal", 1) - 1),
            first_leg_m=self._reached.get(2, math.nan) - self._reached.get(1, math.nan),
            traces=self._notes.traces(self._goals_reached(), tracker),
        )

    def _params(self) -> dict[str, Any]:
        start, goals = self.plan.starts[0], self.plan.goals[: self.settings.goals]
        return {
            "start": {"x": start.x, "y": start.y, "yaw": start.heading},
            "goals": [{"x": goal.x, "y": goal.y, "yaw": goal.heading} for goal in goals],
            **self.settings.scenario.params,
        }

    def _on_status(self, status: Status) -> None:
        """The service's status: it asks for a map with it, and tells which goal is next."""
        reached = status["goal"] - 1 if status["state"] != "succeeded" else status["goals"]
        self._reached.setdefault(reached, self.world.robots[0].distance)
        now = time.monotonic()
        if status["code"] == "no_map" and now - self._mapped_at > _BEAT_S:
            self._mapped_at = now
            self.rig.graph.publish("map", Occupancy(self.plan).message())

    def _goals_reached(self) -> int:
        return max(tuple(self._reached), default=0)  # a copy: another thread adds to it
