"""Closed loops of the whole service over courses: with delay and its compensation, and through cluttered fields.

``skytether lab bench navigation --delays`` and ``--cluttered``. As `bench_loop` it is no part of the service.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skytether.emulator.link_model import LinkConditions
from skytether.lab.world.cluttered import field
from skytether.lab.world.plan import Plan
from skytether.lab.world.simulation import TICK
from skytether.testing.drive import Drive
from skytether_services.planar.geometry import Pose
from skytether_services.planar.transforms import step

from .controller import MotionLimits
from .navigator import Navigator
from .prediction import Compensation, State
from .service import Navigation

Progress = Callable[[str], None]

ROUND_TRIPS = (0.0, 0.05, 0.1, 0.15, 0.2)
"""Without jitter and loss [s]."""
JITTER, LOSS = 0.04, 0.02
"""Of one more link, at the longest round trip: standard deviation of a round trip [s], and share lost on each way."""
CHANGED = (0.05, 0.35)
"""Round trips over which the fixed compensation is told the longest of those above: the link has changed [s]."""
_ERRORS = ("seconds", "path_error", "prediction_error", "prediction_across")
TIME_MARGIN = 1.05
"""The compensated drive at the longest round trip may take so many times what it takes without delay."""
SUCCESS_BAR, SCORE_BAR = 0.95, 0.44
_MOVING = 0.02
"""A robot slower than this does not follow its path [m/s]."""
_PATIENCE = 400.0
_ENDED = ("succeeded", "failed")


@dataclass(frozen=True)
class Course:
    """What came of one drive.

    Attributes:
        state: In the end.
        seconds: Until then, in simulated time.
        path_error: Mean distance of the robot's true place from the newest plan while it moves [m]; NaN: it never did.
        prediction_error: From when the robot was seen until a command arrived, it moved: mean distance of the place to
            which it truly did from the one that was predicted when the command was sent [m]; likewise.
        prediction_across: The part of it across the robot's heading [m]: the delay's own part of the path error. The
            rest lies along the way, and leads off no path.
        contacts: With walls, things and people.
    """

    state: str
    seconds: float
    path_error: float
    prediction_error: float
    prediction_across: float
    contacts: int


class Predictions:
    """What the service predicted of the robot's motion, held against what it was.

    The motion counts, not the place: where the robot believes to be has an error of its own, with any delay.

    Attributes:
        errors: For each command the distance of the place that was predicted from where the robot was [m].
        across: The part of that across its heading [m].
    """

    def __init__(self, now: float) -> None:
        """Begin before the tick that follows ``now`` [s]."""
        self.errors: list[float] = []
        self.across: list[float] = []
        self._begin = _tick(now) + 1
        self._true: list[Pose] = []
        self._expected: dict[int, tuple[State, State]] = {}

    def saw(self, pose: Pose) -> None:
        """Where the robot truly is; told after each tick, from the first on."""
        self._true.append(pose)

    def sent(self, now: float, seen: State, expected: State) -> None:
        """A command is sent now [s]: the robot as the service saw it last, and as it is to be when that arrives."""
        self._expected[_tick(now)] = seen, expected

    def arrived(self, sent: float, now: float) -> None:
        """The command that was sent then arrives now [s]: it acts from the end of the last tick on."""
        if _tick(sent) not in self._expected:
            return
        seen, expected = self._expected.pop(_tick(sent))
        then, here = _tick(seen.time) - self._begin, _tick(now) - 1 - self._begin
        if 0 <= then <= here < len(self._true):
            moved, told = step(self._true[then], self._true[here]), step(seen.pose, expected.pose)
            dx, dy = moved.x - told.x, moved.y - told.y
            self.errors.append(math.hypot(dx, dy))
            self.across.append(abs(dy * math.cos(moved.yaw) - dx * math.sin(moved.yaw)))


def _tick(time: float) -> int:
    return round(time / TICK)


def drive_course(drive: Drive, patience: float) -> Course:
    """Drive until the service is done, for ``patience`` seconds at most."""
    errors: list[float] = []
    predictions = Predictions(drive.harness.now)
    service: Any = drive.harness.service
    navigator: Navigator = service.navigator
    steps = commands = 0
    shown: Any = None
    path = np.empty((0, 2))
    began = drive.world.time

    def predict() -> None:
        nonlocal steps, commands
        predictions.saw(Pose(*drive.robot.pose))
        for sent, arrived in drive.acted[commands:]:
            predictions.arrived(sent, arrived)
        commands = len(drive.acted)
        if len(drive.times) > steps and abs(drive.robot.motion.forward) > _MOVING:
            predictions.sent(drive.harness.now, *navigator.predicted)
        steps = len(drive.times)

    def is_over() -> bool:
        nonlocal shown, path
        predict()
        if drive.world.ticks % 10 == 0 and abs(drive.robot.motion.forward) > _MOVING:
            newest = drive.harness.newest("plan")
            if newest is not shown:
                shown = newest
                path = np.array([(p.pose.position.x, p.pose.position.y) for p in newest.poses]).reshape(-1, 2)
            if len(path) > 1:
                errors.append(distance_from(path, drive.robot.pose[:2]))
        return drive.state in _ENDED

    drive.run(patience, is_over)
    return Course(
        drive.state,
        drive.world.time - began,
        _mean(errors),
        _mean(predictions.errors),
        _mean(predictions.across),
        len(drive.world.contacts),
    )


def _mean(values: list[float]) -> float:
    return float(np.mean(values)) if values else math.nan


def distance_from(path: NDArray[np.float64], point: tuple[float, float]) -> float:
    """Of a point from a polyline, n by 2 [m]."""
    starts, pieces = path[:-1], np.diff(path, axis=0)
    to_point = np.array(point) - starts
    squares = np.maximum((pieces**2).sum(axis=1), 1e-12)
    along = np.clip((to_point * pieces).sum(axis=1) / squares, 0.0, 1.0)
    return float(np.linalg.norm(to_point - along[:, None] * pieces, axis=1).min())


def measure_delays(
    *, plan: Plan, goals: int, runs: int, seed: int, jitter_only: bool, progress: Progress
) -> dict[str, Any]:
    """Time and path error with each compensation over links of more and more delay; nobody walks there.

    Args:
        plan: Of the world; its people are left out.
        goals: So many of the plan's are driven to, at most.
        runs: Over each link with each compensation, with the next seed.
        seed: The first of the world's noise, and of the link's.
        jitter_only: Only the link with jitter and loss, and, measured, the one without delay.
        progress: Told before each drive.
    """
    plan = replace(plan, people=())
    rows: list[dict[str, Any]] = []
    for trip, jitter, loss, told, compensations in _links(jitter_only):
        for compensation in compensations:
            courses = []
            for run in range(seed, seed + runs):
                progress(
                    f"{1000 * trip:.0f} ms, jitter {1000 * jitter:.0f} ms, loss {100 * loss:g} %: {compensation}, {run}"
                )
                # Each way has its own jitter: those of both add up by their squares.
                link = LinkConditions(delay=trip / 2, jitter=jitter / math.sqrt(2), loss=loss, seed=run)
                delay = {"compensation": str(compensation), "fixed_delay": told}
                courses.append(_to_goals(plan, goals, {"delay": delay}, run, link))
            link_given = {"round_trip": trip, "jitter": jitter, "loss": loss, "told": told}
            rows.append({**link_given, "compensation": str(compensation), **summed_up(courses)})
    return {
        "plan": plan.name,
        "goals": min(goals, len(plan.goals)),
        "seed": seed,
        "runs": runs,
        "rows": rows,
        "fixed_against_measured": compared(rows),
        **delay_verdict(rows),
    }


def _links(jitter_only: bool) -> list[tuple[float, float, float, float, list[Compensation]]]:
    """Round trip [s], jitter [s], loss, what the fixed compensation is told [s], and the compensations."""
    every, longest = list(Compensation), ROUND_TRIPS[-1]
    with_jitter = (longest, JITTER, LOSS, longest, every)
    if jitter_only:
        return [(0.0, 0.0, 0.0, 0.0, [Compensation.MEASURED]), with_jitter]
    plain = [(trip, 0.0, 0.0, trip, every) for trip in ROUND_TRIPS]
    told_something: list[Compensation] = [kind for kind in every if kind is not Compensation.OFF]
    return [*plain, with_jitter, *((trip, 0.0, 0.0, longest, told_something) for trip in CHANGED)]


def summed_up(courses: list[Course]) -> dict[str, Any]:
    """Means, standard deviations and single values of drives; one that did not succeed gives all its state."""
    states = [course.state for course in courses]
    found: dict[str, Any] = {"state": next((state for state in states if state != "succeeded"), "succeeded")}
    for name in _ERRORS:
        values = [float(getattr(course, name)) for course in courses]
        found[name] = float(np.mean(values))
        found[f"{name}_std"] = float(np.std(values, ddof=1)) if len(values) > 1 else None
        found[f"{name}_each"] = values
    return {**found, "contacts": sum(course.contacts for course in courses)}


def compared(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Student's t-test of fixed against measured compensation over each link; none of a single drive each.

    In pairs: both drove with the same seeds. With the mean difference, fixed less measured, and where it lies (95 %).
    """
    from scipy.stats import ttest_rel

    by: dict[tuple[float, float, float], dict[str, dict[str, Any]]] = {}
    for row in rows:
        by.setdefault((row["round_trip"], row["jitter"], row["told"]), {})[row["compensation"]] = row
    found = []
    for (trip, jitter, told), kinds in by.items():
        if not {Compensation.FIXED, Compensation.MEASURED} <= kinds.keys():
            continue
        fixed, measured = kinds[Compensation.FIXED], kinds[Compensation.MEASURED]
        for error in _ERRORS[1:]:
            each = fixed[f"{error}_each"], measured[f"{error}_each"]
            differences = np.subtract(*each)
            if len(differences) < 2 or np.ptp(differences) == 0:
                continue
            test = ttest_rel(*each)
            low, high = test.confidence_interval()
            link: dict[str, Any] = {
                "round_trip": trip,
                "jitter": jitter,
                "told": told,
                "error": error,
                "test": "paired",
            }
            between = {"difference": float(differences.mean()), "low": float(low), "high": float(high)}
            found.append({**link, **between, "t": round(float(test.statistic), 2), "p": float(test.pvalue)})
    return found


def delay_verdict(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """What the rows say of the three bars. A drive that did not succeed meets none.

    ``time_within_bar`` is told only if the links that it needs were driven.

    Fixed and measured compensation are compared by what each predicts. Both leave in the path about what the robot errs
    by without delay, so their path errors differ by chance.
    """
    by = {
        (row["round_trip"], row["jitter"], row["compensation"]): row for row in rows if row["told"] == row["round_trip"]
    }
    longest = ROUND_TRIPS[-1]
    prompt, late = (by.get((trip, 0.0, str(Compensation.MEASURED))) for trip in (0.0, longest))
    off, fixed, measured = (by[longest, JITTER, str(kind)] for kind in Compensation)

    def succeeded(*wanted: dict[str, Any]) -> bool:
        return all(each["state"] == "succeeded" for each in wanted)

    verdict = {
        "measured_beats_fixed": succeeded(measured)
        and all(measured[error] < fixed[error] for error in ("prediction_error", "prediction_across")),
        "measured_halves_off": succeeded(measured) and measured["path_error"] <= off["path_error"] / 2,
    }
    if prompt is None or late is None:
        return verdict
    in_time = late["seconds"] <= TIME_MARGIN * prompt["seconds"]
    return {"time_within_bar": succeeded(prompt, late) and in_time, **verdict}


def _to_goals(plan: Plan, goals: int, params: dict[str, Any], seed: int, link: LinkConditions | None = None) -> Course:
    wanted = [{"x": goal.x, "y": goal.y, "yaw": goal.heading} for goal in plan.goals[:goals]]
    with TemporaryDirectory() as folder:
        drive = Drive(Navigation, Path(folder), {"goals": wanted, **params}, plan, seed=seed, link=link)
        return drive_course(drive, _PATIENCE)


def measure_cluttered(*, worlds: int, runs: int, seed: int, progress: Progress) -> dict[str, Any]:
    """Success and score through fields of cylinders. They are made by a generator of our own: it is no BARN score.

    Args:
        worlds: So many fields, from sparse to dense.
        runs: In each, with the next seed of the world's noise.
        seed: Of the fields, and the first of the noise.
        progress: Told before each world.
    """
    top_speed = MotionLimits().max_linear
    rows = []
    for number in range(worlds):
        made = field(number, seed=seed, worlds=worlds)
        optimal = made.length / top_speed
        progress(f"world {number + 1} of {worlds}")
        for run in range(runs):
            course = _to_goals(made.plan, 1, {"seed": seed + run}, seed + run)
            passed = course.state == "succeeded" and not course.contacts
            rows.append(
                {
                    "world": number,
                    "run": run,
                    "optimal": optimal,
                    **asdict(course),
                    "passed": passed,
                    "score": score(passed, optimal, course.seconds),
                }
            )
    success = float(np.mean([row["passed"] for row in rows]))
    mean = float(np.mean([row["score"] for row in rows]))
    return {
        "worlds": worlds,
        "runs": runs,
        "seed": seed,
        "top_speed": top_speed,
        "success": success,
        "score": mean,
        "within_bar": success >= SUCCESS_BAR and mean >= SCORE_BAR,
        "rows": rows,
    }


def score(passed: bool, optimal: float, actual: float) -> float:
    """The optimal time over the actual one, which counts as 2 times the optimal at least and 8 times at most [s]."""
    return optimal / min(max(actual, 2 * optimal), 8 * optimal) if passed else 0.0
