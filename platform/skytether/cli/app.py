"""The command tree of ``skytether``; each command lives in a module of its own."""

from __future__ import annotations

from typing import Annotated

import typer

from skytether import __version__

from .commands import (
    apply,
    demo,
    doctor,
    echo,
    group,
    instance,
    orchestrator,
    relay,
    replay,
    service,
    site,
    site_nodes,
    token,
)
from .commands.bridge import bridge
from .commands.lab import lab
from .commands.robot import commission, gate, registry, run, status
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
registry.app.command("status")(status.status)
app.add_typer(orchestrator.app, name="orchestrator")
app.add_typer(service.app, name="service")
site_nodes.add_to(site.app)
app.add_typer(site.app, name="site")
app.add_typer(group.app, name="group")
app.add_typer(instance.app, name="instance")
registry.app.command("run")(run.run)
app.add_typer(registry.app, name="robot")
app.add_typer(token.app, name="token")
registry.app.command("gate")(gate.gate)
registry.app.command("mode")(gate.mode)
registry.app.command("gate-status")(gate.gate_status)
registry.app.command("safety-log")(gate.safety_log)
registry.app.command("stop")(gate.stop)
registry.app.command("reset")(gate.reset)
registry.app.command("start")(gate.start)
registry.app.command("commission")(commission.commission)
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
