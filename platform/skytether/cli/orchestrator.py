"""``skytether orchestrator``: run the server."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .output import fail

app = typer.Typer(help="Run the orchestrator.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Run the orchestrator."""


@app.command()
def run(
    state_dir: Annotated[
        Path | None,
        typer.Option(help="Folder for database, tokens and instances.  [default: ~/.local/state/skytether]"),
    ] = None,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any free one; see the file `address`.")] = 8600,
    catalog: Annotated[Path | None, typer.Option(help="Folder of manifests beside the built-in ones.")] = None,
    database: Annotated[
        str | None,
        typer.Option(help="SQLAlchemy URL; without it SQLite in the state folder.", envvar="SKYTETHER_DATABASE"),
    ] = None,
    secrets_dir: Annotated[
        Path | None,
        typer.Option(help="Folder of secret.key and operator.token, the same for all orchestrators over one database."),
    ] = None,
    stop_instances: Annotated[
        bool, typer.Option("--stop-instances", help="End all instances at shutdown; otherwise they run on.")
    ] = False,
    open_metrics: Annotated[bool, typer.Option("--open-metrics", help="Let /metrics be read without a token.")] = False,
) -> None:
    """Serve until SIGTERM or Ctrl-C.

    The first start makes the operator's token, in the file operator.token of the state folder. Instances outlive the
    orchestrator, and are adopted by the next one over the same folder, unless --stop-instances is given.
    """
    import logging

    from skytether.orchestrator.server import StartError
    from skytether.orchestrator.server import run as serve
    from skytether.orchestrator.settings import Settings, default_state_dir

    # A server's log instead of a command's warnings.
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s", force=True)
    for chatty in ("alembic", "uvicorn"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
    settings = Settings(
        state_dir=(state_dir or default_state_dir()).absolute(),
        host=host,
        port=port,
        database_url=database,
        secrets_dir=secrets_dir.absolute() if secrets_dir else None,
        catalogue_dir=catalog,
        stop_instances=stop_instances,
        open_metrics=open_metrics,
    )
    try:
        serve(settings)
    except StartError as error:
        fail(str(error), 2 if error.usage else 1)
    except KeyboardInterrupt:  # before there was anything to end
        raise typer.Exit(130) from None
