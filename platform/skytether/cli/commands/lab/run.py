"""``skytether lab run``: experiments of the thesis that drive a service as a robot does."""

from __future__ import annotations

import typer

from .building import building
from .run_follow import follow_in_front
from .run_navigation import navigation

app = typer.Typer(help="Experiments of the thesis that drive a service as a robot does.", no_args_is_help=True)
app.command("building")(building)
app.command("navigation")(navigation)
app.command("follow-in-front")(follow_in_front)
