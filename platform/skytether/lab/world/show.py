"""``skytether lab world``: a run of the world with the guide at the wheel, and what is kept of it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .cluttered import field
from .guide import Guide
from .model import WorldError
from .occupancy import Occupancy
from .picture import Frame, draw_gif, draw_run, frame
from .plan import Plan, building
from .simulation import TICK, Simulation

_FRAME_EVERY = 20
"""Ticks between pictures of the GIF."""
_PROGRESS_EVERY = 100


@dataclass(frozen=True, slots=True)
class Shown:
    """What came of a run.

    Attributes:
        world: Its simulation, at the end.
        goals: How many were reached.
        files: What was written.
    """

    world: Simulation
    goals: int
    files: tuple[Path, ...]

    def document(self) -> dict[str, Any]:
        """As ``skytether lab world --json`` prints it."""
        robot = self.world.robots[0]
        return {
            "plan": self.world.plan.name,
            "goals_reached": self.goals,
            "goals": len(self.world.plan.goals),
            "time_s": round(self.world.time, 2),
            "distance_m": round(robot.distance, 3),
            "contacts": [
                {"time_s": round(c.began, 3), "robot": c.robot, "with": str(c.kind), "name": c.name}
                for c in self.world.contacts
            ],
            "files": [str(path) for path in self.files],
        }


def show(
    output: Path,
    *,
    seed: int = 1,
    people: int = 0,
    limit_s: float = 300.0,
    plan: Plan | None = None,
    record: bool = True,
    on_progress: Callable[[Simulation, int], None] = lambda *_: None,
) -> Shown:
    """Drive the first robot through all goals, as fast as it goes, and write map, PNG, GIF and MCAP.

    Args:
        output: Folder; made if missing.
        seed: Of all noise.
        people: Beyond those who are always there.
        limit_s: Simulated time after which the run ends [s].
        plan: None: the building.
        record: Whether to write the MCAP file.
        on_progress: Told the simulation and how many goals were reached, once a simulated second.

    Raises:
        WorldError: A library is missing, or the plan has no place for so many.
        OSError: Something cannot be written.
    """
    plan = plan or building()
    world = Simulation(plan, seed=seed, rounds=people)
    guide = Guide(plan.goals, world.params)
    robot = world.robots[0]
    output.mkdir(parents=True, exist_ok=True)
    stem = output / f"{plan.name}-seed{seed}"
    files = [*Occupancy(plan).save(output / plan.name), Path(f"{stem}.png"), Path(f"{stem}.gif")]
    frames: list[Frame] = [frame(world)]
    with ExitStack() as stack:
        recorder = None
        if record:
            try:
                from .recording import McapWriter, WorldRecorder
            except ModuleNotFoundError as error:
                if (error.name or "").partition(".")[0] != "mcap":
                    raise
                raise WorldError(
                    "a recording needs the library mcap; install it with: pip install 'skytether[lab]',"
                    " or leave it out with --no-record"
                ) from error
            files.append(Path(f"{stem}.mcap"))
            recorder = WorldRecorder(stack.enter_context(McapWriter(files[-1])))
        while not guide.done and world.time < limit_s:
            robot.write(guide.step(robot.pose, robot.scan))
            found = world.tick()
            if recorder is not None:
                recorder(world, found)
            if world.ticks % _FRAME_EVERY == 0:
                frames.append(frame(world))
            if world.ticks % _PROGRESS_EVERY == 0:
                on_progress(world, guide.reached)
    title = f"{plan.name}: {guide.reached} of {len(plan.goals)} goals, {robot.distance:.1f} m in {world.time:.1f} s"
    draw_run(plan, frames, files[2], contacts=world.contacts, title=title)
    draw_gif(plan, frames, files[3], speed=_FRAME_EVERY * TICK / 0.05, params=world.params)
    return Shown(world, guide.reached, tuple(files))


def show_field(output: Path, number: int, *, seed: int = 1) -> tuple[Path, float]:
    """Draw one of the cluttered fields with its shortest way.

    Returns:
        The PNG, and the length of the way [m].

    Raises:
        ValueError: There is no such field.
        OSError: It cannot be written.
    """
    made = field(number, seed=seed)
    output.mkdir(parents=True, exist_ok=True)
    file = output / f"{made.plan.name}.png"
    world = Simulation(made.plan, seed=seed)
    title = f"field {number}: {len(made.plan.cylinders)} obstacles, shortest way {made.length:.2f} m"
    draw_run(made.plan, [frame(world)], file, title=title, way=made.way)
    return file, made.length
