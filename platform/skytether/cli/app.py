"""The command tree of ``skytether``; each command lives in a module of its own."""

from __future__ import annotations

from typing import Annotated

import typer

from skytether import __version__

from . import (
    apply,
    bridge,
    commission,
    demo,
    doctor,
    echo,
    gate,
    groups,
    lab,
    orchestrator,
    relay,
    replay,
    resources,
    robot_run,
    robot_status,
    site_nodes,
    tokens,
)
from .output import log_to_console

app = typer.Typer(
    help="Cloud robotics: services for robots at the edge or in the cloud, and a bridge that holds.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command()(demo.demo)
app.command()(replay.replay)
app.command()(bridge.bridge)
app.command()(relay.relay)
app.command()(echo.echo)
app.command()(doctor.doctor)
app.command()(apply.apply)
resources.robot_app.command("status")(robot_status.status)
app.add_typer(orchestrator.app, name="orchestrator")
app.add_typer(resources.service_app, name="service")
site_nodes.add_to(resources.site_app)
app.add_typer(resources.site_app, name="site")
app.add_typer(groups.app, name="group")
app.add_typer(resources.instance_app, name="instance")
resources.robot_app.command("run")(robot_run.run)
app.add_typer(resources.robot_app, name="robot")
app.add_typer(tokens.app, name="token")
resources.robot_app.command("gate")(gate.gate)
resources.robot_app.command("mode")(gate.mode)
resources.robot_app.command("gate-status")(gate.gate_status)
resources.robot_app.command("safety-log")(gate.safety_log)
resources.robot_app.command("stop")(gate.stop)
resources.robot_app.command("reset")(gate.reset)
resources.robot_app.command("start")(gate.start)
resources.robot_app.command("commission")(commission.commission)
app.add_typer(lab.app, name="lab")


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
