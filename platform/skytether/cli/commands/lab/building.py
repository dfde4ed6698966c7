"""``skytether lab run building``: navigation tried in the simulated building, with parameters of one's own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from skytether.api.client import ApiError, Unreachable
from skytether.lab.embedded import EmbeddedError
from skytether.lab.trial.errors import TrialError
from skytether.lab.world.model import WorldError

from ...output import console, fail, print_json


def building(
    params: Annotated[Path, typer.Argument(help="YAML file of parameters of the service navigation.")],
    output: Annotated[Path, typer.Option(help="Folder for the picture of the way, and the map.")] = Path("run-output"),
    seconds: Annotated[float, typer.Option(min=1, max=86_400, help="After which the run ends.")] = 600,
    seed: Annotated[int, typer.Option(min=0, help="Of the noise of sensors and odometry.")] = 1,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object, and nothing else.")] = False,
) -> None:
    """A robot in the simulated building is driven by the service navigation, with parameters of your own, in real time.

    With `mode: map` a guide drives it past the building's goals, and the map that the service builds is copied into
    the folder. Ends when all goals were reached or given up, when the guide is through, or when the time is over; with
    exit status 0 unless goals were given up, something was touched, or the robot did not move, or stood at the end.
    """
    from skytether.lab.building_run import ParamsError, drive, read_params

    def print_status(now: float, status: Mapping[str, Any]) -> None:
        if not json:
            code = "" if status.get("code") in ("ok", None) else f" ({status['code']})"
            line = f"{now:6.1f} s  {status['state']}{code}: {status.get('message', '')}"
            console.print(line, markup=False, soft_wrap=True)

    try:
        wanted, readable = read_params(params)
        with console.status("driving ..."):
            done = drive(wanted, output, readable=readable, seconds=seconds, seed=seed, on_status=print_status)
    except (ParamsError, WorldError) as error:
        fail(str(error), 2)
    except (TrialError, EmbeddedError, ApiError, Unreachable) as error:
        fail(str(error))
    except OSError as error:
        fail(f"{error.filename or output}: {error.strerror}")
    if json:
        print_json(done.document())
    else:
        console.print(f"{done.state}: {done.distance_m:.1f} m in {done.time_s:.1f} s, {len(done.contacts)} contacts")
        for file in done.files:
            console.print(str(file), soft_wrap=True, markup=False)
    if done.wrong is not None:
        fail(done.wrong)
