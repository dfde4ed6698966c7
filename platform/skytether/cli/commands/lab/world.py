"""``skytether lab world``: the simulated building."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from skytether.lab.world.cluttered import NoFieldError
from skytether.lab.world.model import WorldError
from skytether.lab.world.plan import PlanError, building, read_plan
from skytether.lab.world.simulation import Simulation

from ...output import console, fail, print_json


def world(
    output: Annotated[Path, typer.Option(help="Folder for map, pictures and recording.")] = Path("world-output"),
    plan: Annotated[Path | None, typer.Option(help="A plan of your own, as YAML. Default: the building.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the noise of sensors and odometry.")] = 1,
    people: Annotated[int, typer.Option(min=0, help="People who walk their rounds, beyond the one of the plan.")] = 0,
    seconds: Annotated[float, typer.Option(min=1, max=3600, help="Simulated time after which the run ends.")] = 300,
    record: Annotated[bool, typer.Option("--record/--no-record", help="Write the MCAP file.")] = True,
    field: Annotated[
        int | None, typer.Option(min=0, max=49, help="Only draw this field of cylinders, with its shortest way.")
    ] = None,
    live: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="Show it in real time in a browser, on this port; 0: any free one."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object, and nothing else.")] = False,
) -> None:
    """A robot in a simulated building: nine goals on a way of 41 m, and a person who steps in (thesis, section 5.6.2).

    Writes the building's map (map_server's YAML and PGM), a picture of the run from above (PNG), how it went (GIF),
    and all that the robot measured (MCAP with ROS 2 messages, for Foxglove). No service is asked: a guide that knows
    where the robot is drives, and stands before what the laser sees. Ends with exit status 0 only if all goals were
    reached without a contact.
    """
    from skytether.lab.world.live import serve
    from skytether.lab.world.show import show, show_field

    try:
        if field is not None:
            file, length = show_field(output, field, seed=seed)
            if json:
                print_json({"field": field, "shortest_m": round(length, 3), "files": [str(file)]})
            else:
                console.print(f"shortest way {length:.2f} m: {file}", soft_wrap=True)
            return
        chosen = read_plan(plan) if plan is not None else None
        if live is not None:
            with suppress(KeyboardInterrupt):
                serve(
                    Simulation(chosen or building(), seed=seed, rounds=people),
                    live,
                    lambda url: console.print(f"open {url} in a browser; Ctrl-C ends it", soft_wrap=True),
                )
            return
        with console.status("compiling ...") as line:
            done = show(
                output,
                seed=seed,
                people=people,
                limit_s=seconds,
                plan=chosen,
                record=record,
                on_progress=lambda world, goals: line.update(f"{world.time:.0f} s, goal {goals + 1} ..."),
            )
    except (PlanError, WorldError, NoFieldError) as error:
        fail(str(error), 2)
    except OSError as error:
        fail(f"{error.filename or output}: {error.strerror}")
    facts = done.document()
    if json:
        print_json(facts)
    else:
        console.print(
            f"{facts['goals_reached']} of {facts['goals']} goals, {facts['distance_m']:.1f} m"
            f" in {facts['time_s']:.1f} s, {len(facts['contacts'])} contacts"
        )
        for contact in facts["contacts"]:
            console.print(
                f"at {contact['time_s']:.2f} s robot {contact['robot']} touched {contact['name']}", markup=False
            )
        for path in facts["files"]:
            console.print(path, soft_wrap=True, markup=False)
    if facts["goals_reached"] < facts["goals"] or facts["contacts"]:
        fail("not all goals were reached without a contact")
