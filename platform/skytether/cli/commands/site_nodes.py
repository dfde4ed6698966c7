"""``skytether site invite, join, run, leave, drain, resume, remove``: machines that join by themselves, and go."""

from __future__ import annotations

import re
import sys
import time
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..connection import Json, TokenFile, Url, connected
from ..names import SiteName
from ..output import console, fail, fail_all, plain, print_json
from .site import app, options_of

if TYPE_CHECKING:
    from skytether.api.client import Client
    from skytether.api.rest import Site
    from skytether.node.checks import Finding
    from skytether.node.join import Joined
    from skytether.node.store import NodeStore

_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}
_FOLDER = Path("/etc/skytether/node")
_LONGEST_S = 86_400.0
_POLL_S = 0.5
Folder = Annotated[Path, typer.Option(help="Where the node's key and certificate are.")]
Patience = Annotated[
    float, typer.Option("--timeout-s", min=0, help="How long to wait for what runs there to be moved, or to end.")
]


def invite_node(
    name: Annotated[str, typer.Argument(help="Of the site that the machine will be.")],
    tier: Annotated[str, typer.Option(help="edge or cloud.")] = "edge",
    valid: Annotated[
        str, typer.Option(help="How long the token is good for, such as 30m or 1h; a day at most.")
    ] = "1h",
    option: Annotated[
        list[str] | None,
        typer.Option(
            help="KEY=VALUE of the Docker runtime's options; may be given again. It goes before the machine's."
        ),
    ] = None,
    speed: Annotated[float, typer.Option(min=0.001, help="Of one core, beside the one services are stated for.")] = 1.0,
    cost: Annotated[float, typer.Option(min=0, help="Of one instance, for placement.")] = 0.0,
    image: Annotated[
        list[str] | None, typer.Option(help="Pattern of images that may run there; may be given again; all else.")
    ] = None,
    url: Url = None,
    token_file: TokenFile = None,
    json: Json = False,
) -> None:
    """Make a token with which one machine may join, once. It is printed on standard output, this once.

    With it goes the fingerprint of the key by which the machine knows the orchestrator. A token for the same name that
    was not used is worth nothing any more.
    """
    from pydantic import ValidationError

    from skytether.api.rest import Invite

    asked = {"name": name, "tier": tier, "options": options_of(option), "speed": speed, "cost": cost}
    try:
        request = Invite.model_validate({**asked, "images": tuple(image or ("*",)), "ttl_s": _seconds(valid)})
    except ValidationError as error:
        first = error.errors()[0]
        fail(f"{'.'.join(str(p) for p in first['loc'])}: {first['msg'][:1].lower()}{first['msg'][1:]}", 2)
    with connected(url, token_file) as client:
        made = client.invite(request)
    if json:
        print_json(plain(made))
        return
    where = ",".join(made.urls) or f"https://ORCHESTRATOR:{made.port}"
    console.print(
        f"on the machine that is to be site {made.name}, before {made.expires_at:%Y-%m-%d %H:%M:%S} UTC:", markup=False
    )
    console.print(f"  skytether site join {where} --token-file -", markup=False, soft_wrap=True)
    console.print("with this token, which cannot be shown again:", markup=False)
    typer.echo(made.token)


def _seconds(text: str) -> float:
    unit = _UNITS.get(text[-1:].lower())
    try:
        seconds = float(text[:-1] if unit else text) * (unit or 1.0)
    except ValueError:
        seconds = 0.0
    if not 1 <= seconds <= _LONGEST_S:
        fail(f"--valid {text}: write 90s, 30m or 1h; 24h at most", 2)
    return seconds


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
    from skytether.node.join import ChecksError, JoinOptions, join
    from skytether.node.store import NodeError

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
    import asyncio
    import contextlib

    from skytether.bridge.echo import EchoServer
    from skytether.node.run import NodeProgram
    from skytether.node.store import NodeError, NodeStore

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
    import logging

    from skytether.api.printable import printable

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
    from skytether.node.join import leave
    from skytether.node.store import NodeError

    store = _store(folder)
    if not force and not store.exists():
        fail(f"this machine has not joined, as far as {store.folder} says")
    try:
        left = leave(store, force=force, timeout_s=timeout_s, tell=lambda text: console.print(text, markup=False))
    except NodeError as error:
        fail(str(error))
    if left is not None:
        console.print(f"the orchestrator does not know: {left}", markup=False, soft_wrap=True)
        console.print(
            "what ran here may run still: docker rm -f $(docker ps -aq --filter label=skytether.io/owner)", markup=False
        )
    console.print("this machine is no site any more", markup=False)


def _store(folder: Path) -> NodeStore:
    from skytether.node.store import NodeStore

    return NodeStore(folder.expanduser().absolute())


def drain_site(
    name: SiteName,
    wait: Annotated[bool, typer.Option(help="Wait until nothing runs there any more.")] = True,
    timeout_s: Patience = 600.0,
    url: Url = None,
    token_file: TokenFile = None,
    json: Json = False,
) -> None:
    """Have a site take no more instances, and move those that are there: before it is updated, say.

    Each robot is handed over before the old instance ends. `skytether site resume` has the site take instances again.
    """
    with connected(url, token_file) as client:
        site = client.drain_site(name)
        deadline, told = time.monotonic() + timeout_s, ""
        while wait and site.instances:
            told = _tell(_left(site), told)
            if time.monotonic() >= deadline:
                fail(f"{_left(site)}; `skytether instance list` says why")
            time.sleep(_POLL_S)
            site = _look(client, name) or site
    if json:
        print_json(plain(site))
    else:
        console.print(f"site {name} takes no more instances; {site.instances} are there", markup=False)


def resume_site(
    name: SiteName,
    wait: Annotated[bool, typer.Option(help="Wait until instances can be started there.")] = True,
    timeout_s: Annotated[float, typer.Option("--timeout-s", min=0, help="How long to wait for that.")] = 300.0,
    url: Url = None,
    token_file: TokenFile = None,
    json: Json = False,
) -> None:
    """Have a site that was drained take instances again, and wait until it can: before the next one is drained.

    One that does not come back is told of, with status 1; it takes instances as soon as it does.
    """
    with connected(url, token_file) as client:
        site = client.resume_site(name)
        deadline, told = time.monotonic() + timeout_s, ""
        while wait and site.state != "ready":
            told = _tell(text := f"site {name} is {site.state}: {site.reason}", told)
            if time.monotonic() >= deadline:
                fail(text)
            time.sleep(_POLL_S)
            site = _look(client, name) or site
    if json:
        print_json(plain(site))
    else:
        console.print(f"site {name} takes instances again", markup=False)


def remove_site(
    name: SiteName,
    force: Annotated[
        bool,
        typer.Option("--force", help="At once, with all that is there: for a machine that is gone for good."),
    ] = False,
    wait: Annotated[bool, typer.Option(help="Wait until it is gone.")] = True,
    timeout_s: Patience = 600.0,
    url: Url = None,
    token_file: TokenFile = None,
) -> None:
    """Drain a site, and forget it with its last instance. The certificate of a machine that joined is no good then."""
    from skytether.api.client import ApiError

    with connected(url, token_file) as client:
        if force:
            client.delete_site(name, force=True)
        else:
            client.drain_site(name)
            gone = client.delete_site(name, drain=True)
            deadline, told = time.monotonic() + timeout_s, ""
            while wait and not gone:
                try:
                    left = _left(site) if (site := _look(client, name)) else "no orchestrator answers"
                except ApiError as error:
                    if error.problem.status != HTTPStatus.NOT_FOUND:
                        raise
                    break
                told = _tell(left, told)
                if time.monotonic() >= deadline:
                    fail(f"{left}: site {name} goes with its last instance; with --force it goes now")
                time.sleep(_POLL_S)
            if not wait and not gone:
                console.print(f"site {name} goes when what runs there was moved, or has ended", markup=False)
                return
    console.print(f"site {name} is gone", markup=False)


def _left(site: Site) -> str:
    return f"{site.instances} instances are at site {site.name} still"


def _look(client: Client, name: str) -> Site | None:
    """A site as it is now; None: no orchestrator answers, as while it is updated.

    Raises:
        ApiError: There is no such site, or we may not see it.
    """
    from skytether.api.client import ApiError, Unreachable

    try:
        return client.get_site(name)
    except Unreachable:
        return None
    except ApiError as error:
        if error.problem.status != HTTPStatus.SERVICE_UNAVAILABLE:
            raise
        return None


def _tell(text: str, told: str) -> str:
    if text != told:
        console.print(text, markup=False)
    return text


app.command("invite")(invite_node)
app.command("join")(join_node)
app.command("run")(run_node)
app.command("leave")(leave_node)
app.command("drain")(drain_site)
app.command("resume")(resume_site)
app.command("remove")(remove_site)
