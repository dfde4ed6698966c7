"""The command tree of ``skytether``; each command lives in a module of its own, which is imported when it is used."""

from __future__ import annotations

from typing import Annotated

import typer

from skytether import __version__

from .lazy import Lazy, LazyGroup
from .output import log_to_console


class _Commands(LazyGroup):
    table = {
        "demo": Lazy("demo", "demo", "Guide a simulated smart walker along the trail, across an emulated network."),
        "replay": Lazy(
            "replay",
            "replay",
            "Stream a recording to a service: through orchestrator and bridge, at its own times, byte for byte.",
        ),
        "bridge": Lazy(
            "bridge.bridge",
            "bridge",
            "Join two graphs over UDP without an orchestrator: run it at each end with the same id, key and topics.",
        ),
        "relay": Lazy(
            "relay",
            "relay",
            "Forward bridge sessions by their id, without a key: one public port for many services, or hop by hop.",
        ),
        "echo": Lazy(
            "echo",
            "echo",
            "Answer UDP echoes until interrupted. Never sends more than it gets, little to each address, needs no"
            " token.",
        ),
        "doctor": Lazy(
            "doctor", "doctor", "Look for what usually goes wrong between a robot and its services, and say what to do."
        ),
        "apply": Lazy(
            "apply",
            "apply",
            "Make the catalog's services as the files say: created, changed or left as they are. May be run again.",
        ),
        "orchestrator": Lazy("orchestrator", "app", "Run the orchestrator."),
        "service": Lazy("service", "app", "What robots can ask for."),
        "site": Lazy("site.app", "app", "Where instances run."),
        "group": Lazy("group", "app", "Groups of sites, whose machines come and go as they are needed."),
        "instance": Lazy("instance", "app", "What runs, for whom."),
        "robot": Lazy("robot.app", "app", "Who may ask; and what runs on a robot: its agent and its gate."),
        "token": Lazy("token", "app", "Tokens of robots and operators."),
        "lab": Lazy("lab.app", "app", "Experiments and benchmarks on this machine."),
    }


app = typer.Typer(
    cls=_Commands,
    help="Cloud robotics: services for robots at the edge or in the cloud, and a bridge that holds.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback()
def root(
    version: Annotated[  # noqa: ARG001 (its callback acts)
        bool,
        typer.Option("--version", help="Print the version and end.", is_eager=True, callback=lambda v: _version(v)),
    ] = False,
) -> None:
    """Read what holds for all commands."""
    log_to_console()


def _version(wanted: bool) -> None:
    if wanted:
        print(__version__)
        raise typer.Exit
