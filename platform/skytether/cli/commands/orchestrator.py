"""``skytether orchestrator``: run the server."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skytether.orchestrator.backup import BackupError, backup, restore
from skytether.orchestrator.config.defaults import default_state_dir
from skytether.orchestrator.domain.errors import ConflictError, InvalidError, OutdatedError
from skytether.orchestrator.domain.security import SecretFileError
from skytether.orchestrator.runtimes.base import RuntimeFailure
from skytether.orchestrator.telemetry.audit import AuditError, verify

from ..output import console, fail

if TYPE_CHECKING:
    from skytether.orchestrator.store.store import Store

app = typer.Typer(help="Run the orchestrator.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Run the orchestrator."""


@app.command()
def run(
    config: Annotated[
        Path | None,
        typer.Option(help="YAML file; `skytether orchestrator config` prints one.", envvar="SKYTETHER_CONFIG"),
    ] = None,
    state_dir: Annotated[
        Path | None,
        typer.Option(help="Folder for database, tokens and instances.  [default: ~/.local/state/skytether]"),
    ] = None,
    host: Annotated[str | None, typer.Option(help="Address to listen on.  [default: 127.0.0.1]")] = None,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="0: any free one; see the file `address`.  [default: 8600]")
    ] = None,
    catalog: Annotated[Path | None, typer.Option(help="Folder of manifests beside the built-in ones.")] = None,
    database: Annotated[
        str | None,
        typer.Option(
            help="postgresql://USER@HOST/NAME, without a password: all users see arguments. Without it SQLite in the "
            "state folder."
        ),
    ] = None,
    secrets_dir: Annotated[
        Path | None,
        typer.Option(
            help="Folder of secret.key and operator.token, the same for all orchestrators over one database; made "
            "where it is not there."
        ),
    ] = None,
    stop_instances: Annotated[
        bool | None,
        typer.Option("--stop-instances", help="End all instances at shutdown; otherwise they run on."),
    ] = None,
    insecure_http: Annotated[
        bool | None,
        typer.Option("--insecure-http", help="Plain HTTP beyond loopback: tokens can be read on the way."),
    ] = None,
    open_metrics: Annotated[
        bool | None, typer.Option("--open-metrics", help="Let /metrics be read without a token.")
    ] = None,
) -> None:
    """Serve until SIGTERM or Ctrl-C.

    The first start makes the operator's token, in the file operator.token of the state folder. Instances outlive the
    orchestrator, and are adopted by the next one over the same folder, unless --stop-instances is given.

    Every key of the configuration is a variable of the environment too, which goes before the file; options go before
    both. TLS, logs, limits and the reconciler's patience are set there: see `skytether orchestrator config`.
    """
    from skytether.orchestrator.config.sources import load, seen_by_others
    from skytether.orchestrator.http.server import StartError
    from skytether.orchestrator.http.server import run as serve

    given = {
        "state_dir": state_dir,
        "host": host,
        "port": port,
        "database_url": database,
        "secrets_dir": secrets_dir,
        "catalog_dir": catalog,
        "stop_instances": stop_instances,
        "insecure_http": insecure_http,
        "open_metrics": open_metrics,
    }
    try:
        settings = load(config, os.environ, given)
        if warning := seen_by_others(config, given):
            typer.echo(f"warning: {warning}", err=True)
        serve(settings)
    except InvalidError as error:
        fail(str(error), 2)
    except StartError as error:
        fail(str(error), 2 if error.usage else 1)
    except KeyboardInterrupt:  # before there was anything to end
        raise typer.Exit(130) from None


@app.command("config")
def show_config(
    markdown: Annotated[bool, typer.Option("--markdown", help="As the page of the documentation.")] = False,
) -> None:
    """Print a configuration file with every key, its default and what it means."""
    from skytether.orchestrator.config.sources import example, page

    typer.echo(page() if markdown else example(), nl=False)


audit_app = typer.Typer(help="Who did what.", no_args_is_help=True)
app.add_typer(audit_app, name="audit")


@audit_app.callback()
def _audit_group() -> None:
    """Who did what."""


@audit_app.command("verify")
def verify_audit(
    file: Annotated[Path, typer.Argument(help="The file that logs.audit_file names.")],
    last: Annotated[str | None, typer.Option(help="A hash noted earlier, or elsewhere, that must be in it.")] = None,
) -> None:
    """Look whether a line of an audit file was changed, taken away or put in; those that were full before it included.

    That its end was cut off shows only by a hash that was noted elsewhere: give it with --last.
    """
    try:
        checked = verify(file, last)
    except AuditError as error:
        fail(str(error))
    since = "" if checked.first == 1 else f", from number {checked.first} on: the files before are elsewhere"
    console.print(f"{checked.lines} lines are as they were written{since}", markup=False)
    console.print(f"last hash: {checked.last_hash}", markup=False, soft_wrap=True)


StateDir = Annotated[
    Path | None, typer.Option(help="Folder of the orchestrator's state.  [default: ~/.local/state/skytether]")
]


class Secret(StrEnum):
    """What can be made anew."""

    SECRET_KEY = "secret-key"  # noqa: S105 (its name)
    OPERATOR_TOKEN = "operator-token"  # noqa: S105


@app.command("rotate")
def rotate(
    what: Annotated[
        Secret, typer.Argument(help="What all keys of sessions are derived from, or the operator's token.")
    ],
    state_dir: StateDir = None,
    secrets_dir: Annotated[
        Path | None, typer.Option(help="Where these are, if not in the state folder.", envvar="SKYTETHER_SECRETS_DIR")
    ] = None,
) -> None:
    """Make a secret anew while the orchestrator runs, which uses it within seconds; no session ends.

    Sessions keep the secret key that they began with; it stays beside the new one, and is deleted when the last of them
    has ended. The old operator's token is worth nothing from then on.
    """
    from skytether.orchestrator.access.rotation import rotate_key, rotate_operator

    folder = (secrets_dir or state_dir or default_state_dir()).expanduser()
    try:
        if what is Secret.SECRET_KEY:
            console.print(f"sessions that run keep {rotate_key(folder)}", markup=False, soft_wrap=True)
        else:
            console.print(f"made {rotate_operator(folder)} anew", markup=False, soft_wrap=True)
    except SecretFileError as error:
        fail(str(error))


@app.command("dismantle")
def dismantle_sites(
    file: Annotated[Path, typer.Argument(help="YAML of sites, as the setting sites_file has it.")],
    state_dir: StateDir = None,
    database: Annotated[
        str | None,
        typer.Option(
            help="PostgreSQL that the orchestrators had, which knows the machines of groups; without it the SQLite of "
            "the state folder.",
            envvar="SKYTETHER_DATABASE_URL",
            show_default=False,
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Also where no database says which machines the groups have: they stay.")
    ] = False,
) -> None:
    """End and remove all that is at the sites of a file, and destroy the machines of its groups.

    For when their orchestrators are gone for good: whatever runs there ends.
    """
    from skytether.orchestrator.config.sites_file import read_groups, read_sites
    from skytether.orchestrator.groups.group_end import end_groups
    from skytether.orchestrator.scheduling.sites import dismantle

    folder = (state_dir or default_state_dir()).expanduser()
    try:
        declared, groups = read_sites(file), [one.name for one in read_groups(file)]
        if groups and database is None and not (folder / "state.db").exists():
            text = f"machines of {', '.join(groups)} are known to the orchestrators' database only"
            if not force:
                fail(f"{text}: name it (--database), or its folder (--state-dir); with --force they stay")
            console.print(f"warning: {text}, and stay", markup=False)
        elif groups:
            with _store(database or f"sqlite:///{folder / 'state.db'}") as store:
                ended = end_groups(store, groups, folder / "groups")
            console.print(f"{len(ended)} machines of {', '.join(groups)} are destroyed", markup=False)
        dismantle(declared, folder / "sites")
    except InvalidError as error:
        fail(str(error), 2)
    except (ConflictError, RuntimeFailure) as error:
        fail(str(error))
    console.print(f"nothing is left at {', '.join(one.name for one in declared) or 'no site'}", markup=False)


@contextmanager
def _store(address: str) -> Iterator[Store]:
    """The database; one that cannot be used ends the command with one sentence."""
    from sqlalchemy.exc import SQLAlchemyError

    from skytether.orchestrator.store.engine import AddressError
    from skytether.orchestrator.store.store import Store

    try:
        store = Store(address)
        try:
            yield store
        finally:
            store.close()
    except (AddressError, OutdatedError) as error:
        fail(str(error))
    except SQLAlchemyError as error:
        fail(f"the database cannot be used: {str(error).splitlines()[0]}")


@app.command("backup")
def back_up(
    to: Annotated[Path, typer.Argument(help="A folder that is not there yet.")], state_dir: StateDir = None
) -> None:
    """Copy database, secret key and operator's token, while the orchestrator runs. Keep the copy as secret as these."""
    try:
        copied = backup((state_dir or default_state_dir()).expanduser(), to)
    except BackupError as error:
        fail(str(error))
    console.print(f"copied {', '.join(copied)} to {to}")


@app.command("restore")
def restore_copy(
    source: Annotated[Path, typer.Argument(help="What `backup` made.")], state_dir: StateDir = None
) -> None:
    """Put a copy into a state folder that holds none, before an orchestrator is started over it."""
    try:
        put = restore(source, (state_dir or default_state_dir()).expanduser())
    except BackupError as error:
        fail(str(error))
    console.print(f"restored {', '.join(put)}")
