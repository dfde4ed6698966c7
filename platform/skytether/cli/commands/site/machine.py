"""``skytether site join, run, leave``: this machine as a site."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skytether.api.printable import printable
from skytether.bridge.echo import EchoServer
from skytether.node.join import ChecksError, JoinOptions, join, leave
from skytether.node.run import NodeProgram
from skytether.node.store import NodeError, NodeStore

from ...connection import Json
from ...output import console, fail, fail_all, plain, print_json
from .drain import Patience

if TYPE_CHECKING:
    from skytether.node.checks import Finding
    from skytether.node.join import Joined

_FOLDER = Path("/etc/skytether/node")
Folder = Annotated[Path, typer.Option(help="Where the node's key and certificate are.")]


def join_node(
    orchestrator: Annotated[
        str,
        typer.Argument(help="https://HOST[:PORT] where nodes connect, port 8603 unless given; several with commas."),
    ],
    token_file: Annotated[
        str | None, typer.Option("--token-file", help="File with the join token; - for standard input.")
    ] = None,
    token: Annotated[
        str | None, typer.Option(help="The join token; all users of this machine can read it meanwhile.")
    ] = None,
    engine: Annotated[
        str, typer.Option(help="Socket of this machine's Docker engine.")
    ] = "unix:///var/run/docker.sock",
    advertise: Annotated[
        str | None,
        typer.Option(
            help="Address by which robots reach this machine; without it that of its way to the orchestrator, also "
            "when that changes.",
            show_default=False,
        ),
    ] = None,
    ports: Annotated[
        str | None,
        typer.Option(
            help="FIRST-LAST, UDP ports for sessions as a firewall lets them through; the engine's choice else."
        ),
    ] = None,
    echo_port: Annotated[
        int, typer.Option(min=0, max=65_535, help="UDP port of the echo for robots' probes; 0: none.")
    ] = 8600,
    device: Annotated[
        list[str] | None,
        typer.Option(help="File of a device that services here may have, such as /dev/video0; may be given again."),
    ] = None,
    registry: Annotated[
        list[str] | None,
        typer.Option(
            help="HOST[:PORT] from which images are pulled, and from no other; may be given again. Without it: from "
            "any that is not this machine itself."
        ),
    ] = None,
    unfiltered: Annotated[
        bool,
        typer.Option(
            "--unfiltered",
            help="Pass on whatever the orchestrator asks of the engine: whoever takes it over is root here then.",
        ),
    ] = False,
    folder: Folder = _FOLDER,
    unit: Annotated[
        bool, typer.Option("--unit/--no-unit", help="Have systemd run it; otherwise run `skytether site run` yourself.")
    ] = True,
    json: Json = False,
) -> None:
    """Make this machine a site. It calls the orchestrator; nothing has to call it, so it may be behind a NAT.

    Looks first at engine, memory, disk, clock, ports, address and orchestrator, and changes nothing if one of them is
    not good. Its key never leaves it. What was begun is taken back if anything fails.
    """
    options = JoinOptions(
        urls=tuple(part.strip().rstrip("/") for part in orchestrator.split(",") if part.strip()),
        token=_token(token_file, token),
        engine=engine,
        advertise=advertise,
        ports=_ports(ports),
        echo=echo_port or None,
        devices=_devices(device),
        registries=_registries(registry),
        unfiltered=unfiltered,
        folder=folder.expanduser().absolute(),
        unit=unit,
    )
    try:
        joined = join(options, lambda finding: None if json else _show_finding(finding))
    except ChecksError as error:
        fail_all([f"{finding.check}: {finding.says}" for finding in error.findings])
    except NodeError as error:
        fail(str(error))
    if json:
        print_json({"name": joined.name, "address": joined.address, "took_s": joined.took_s, **plain(joined.stands)})
    else:
        _show_joined(joined, options.folder, echo_port, unit=unit)


def _token(file: str | None, text: str | None) -> str:
    if (file is None) == (text is None):
        fail("give the join token with --token-file FILE, or - for standard input", 2)
    if text is not None:
        console.print(
            "note: all users of this machine could read the token among the arguments; --token-file - is safer"
        )
        return text
    try:
        return sys.stdin.readline() if file == "-" else Path(str(file)).read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError) as error:
        fail(f"cannot read the token file {file}: {getattr(error, 'strerror', None) or 'it is no text'}", 2)


def _devices(given: list[str] | None) -> tuple[str, ...]:
    for path in given or ():
        if not path.startswith("/dev/") or not re.fullmatch(r"[A-Za-z0-9._/-]+", path):
            fail(f"--device {path}: write the path of a device, such as /dev/video0", 2)
    return tuple(given or ())


def _registries(given: list[str] | None) -> tuple[str, ...]:
    for name in given or ():
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9.-]*(:\d{1,5})?", name):
            fail(f"--registry {name}: write HOST or HOST:PORT, such as docker.io or registry.example:5000", 2)
    return tuple(given or ())


def _ports(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    first, _, last = text.partition("-")
    if not (first.isdecimal() and last.isdecimal()) or not 0 < int(first) <= int(last) < 1 << 16:
        fail(f"--ports {text}: write FIRST-LAST, such as 20000-20099", 2)
    return int(first), int(last)


def _show_finding(finding: Finding) -> None:
    mark = "[red]trouble[/]" if not finding.good else "[yellow]   note[/]" if finding.warning else "[green]     ok[/]"
    console.print(f"{mark} [bold]{finding.check}[/]: ", end="")
    console.print(finding.says, markup=False, soft_wrap=True)


def _show_joined(joined: Joined, folder: Path, echo_port: int, *, unit: bool) -> None:
    stands = joined.stands
    console.print(f"this machine is site {joined.name} now: {stands.cpu:g} cores, {stands.memory_mb} MiB", markup=False)
    if stands.state == "blocked":
        console.print(f"nothing can be started yet: {stands.reason}", markup=False, soft_wrap=True)
    if stands.echo is False:
        console.print(
            f"note: UDP {joined.address}:{echo_port} does not answer the orchestrator, so robots there would not reach "
            f"this machine either: open it in the firewall; `skytether doctor --echo {joined.address}:{echo_port}` "
            "from where the robots are shows it",
            markup=False,
            soft_wrap=True,
        )
    if unit:
        console.print("it runs as skytether-node.service; `journalctl -u skytether-node` is its log", markup=False)
    else:
        console.print(f"start it, now and at each boot: skytether site run --folder {folder}", markup=False)
    if echo_port:
        console.print(
            f"robots: in robot.yaml, task.echoes: {{{joined.name}: {joined.address}:{echo_port}}}; "
            f"at the orchestrator: skytether site show {joined.name}",
            markup=False,
            soft_wrap=True,
        )


def run_node(folder: Folder = _FOLDER) -> None:
    """Be the site that this machine joined as, until interrupted.

    Keeps the orchestrators' ways to its engine, and renews its certificate. The unit that `skytether site join` writes
    runs this. What runs in containers goes on when this ends.
    """
    _log_everything()
    store = NodeStore(folder.expanduser().absolute())
    try:
        with contextlib.ExitStack() as stack:
            config = store.config()
            program = NodeProgram(store)
            if config.echo is not None:
                try:
                    stack.enter_context(EchoServer("0.0.0.0", config.echo))  # noqa: S104 (it is for robots)
                except OSError as error:
                    console.print(f"no echo on UDP port {config.echo}: {error.strerror}", markup=False)
            asyncio.run(program.run())
    except NodeError as error:
        fail(str(error))


def _log_everything() -> None:

    class OneLine(logging.Formatter):
        def format(self, record: logging.LogRecord) -> str:
            return printable(super().format(record))

    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(OneLine("%(levelname)s %(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
    logging.getLogger("asyncio").setLevel(logging.WARNING)


def leave_node(
    force: Annotated[
        bool, typer.Option("--force", help="At once, with what runs here, and also where no orchestrator answers.")
    ] = False,
    timeout_s: Patience = 600.0,
    folder: Folder = _FOLDER,
) -> None:
    """Undo the join of this machine: what runs here is moved elsewhere first, then nothing of it is left."""
    store = _store(folder)
    if not force and not store.exists():
        fail(f"this machine has not joined, as far as {store.folder} says")
    try:
        left = leave(
            store,
            force=force,
            timeout_s=timeout_s,
            on_progress=lambda text: console.print(text, markup=False, soft_wrap=True),
        )
    except NodeError as error:
        fail(str(error))
    if left is not None:
        console.print(f"the orchestrator does not know: {left}", markup=False, soft_wrap=True)
    console.print("this machine is no site any more", markup=False)


def _store(folder: Path) -> NodeStore:

    return NodeStore(folder.expanduser().absolute())
