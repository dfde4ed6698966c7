"""Joining and leaving: all of it or nothing, on either side."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlencode

from skytether.api.node import Invited, Issued, Join, Leave, Look, Standing, Stands
from skytether.bridge.echo import EchoServer

from . import checks, unit
from .calls import FirstAnswer, RefusedError, UnreachableError, address_of, call, first_call, trusting
from .checks import Finding
from .engine_rules import OWNER
from .machine import EngineInfo, address_towards, ask, describe
from .run import NodeProgram
from .store import NodeConfig, NodeError, NodeStore, new_key, request_for

_TOKEN = re.compile(r"sky-[0-9a-f]{64}\.[0-9a-f]{64}")
POLL_S, LEFT_S = 0.1, 1.0
"""Between two looks whether a site answers, and whether one that leaves is gone."""
_READY_S = 300.0
"""By when a site that joined has answered: a slow machine takes a minute to start a program."""
LOOK_S = 5.0
"""Between two looks whether the unit comes up at all."""
_MOST_LIST = 64 << 20
"""Bytes of a list of containers."""
LOCAL_SOCKET = "/var/run/docker.sock"
"""The one that `docker` asks by itself."""


class ChecksError(NodeError):
    """This machine cannot join as it is; ``findings`` say why."""

    def __init__(self, findings: list[Finding]) -> None:
        self.findings = findings
        super().__init__("; ".join(finding.says for finding in findings))


@dataclass(frozen=True)
class JoinOptions:
    """How a machine is to join."""

    urls: tuple[str, ...]
    token: str
    engine: str = f"unix://{LOCAL_SOCKET}"
    advertise: str | None = None
    """That robots are told; None: the address by which this machine reaches the orchestrator, whatever it is then."""
    ports: tuple[int, int] | None = None
    echo: int | None = 8600
    devices: tuple[str, ...] = ()
    """That containers may have."""
    registries: tuple[str, ...] = ()
    """From which alone images are pulled; none: from any that is not this machine itself."""
    unfiltered: bool = False
    """Let an orchestrator ask the engine for anything."""
    folder: Path = Path("/etc/skytether/node")
    unit: bool = True
    program: str = ""
    """What the unit runs."""


@dataclass(frozen=True)
class Joined:
    """What came of it."""

    name: str
    address: str
    stands: Stands
    took_s: dict[str, float]
    """By step [s]."""


class _Steps:
    def __init__(self) -> None:
        self.took_s: dict[str, float] = {}

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        began = time.monotonic()
        yield
        self.took_s[name] = time.monotonic() - began


def join(options: JoinOptions, on_finding: Callable[[Finding], object] = lambda _: None) -> Joined:
    """Make this machine a site.

    Nothing is changed before all checks are good, and what was changed is taken back if anything fails after that.

    Args:
        options: How.
        on_finding: Called with what each check found.

    Raises:
        ChecksError: This machine cannot join as it is.
        NodeError: It did not work; the text says what to do.
    """
    store, steps = NodeStore(options.folder), _Steps()
    token, pin = _parts(options.token)
    if store.exists():
        raise NodeError(
            f"this machine is the site '{store.config().name}' already: run `skytether site leave` first, or give "
            "another --folder"
        )
    path = engine_path(options.engine)
    with steps.step("checks"):
        url, seen, engine = _check(options, pin, path, on_finding)
    trust = trusting(seen.authority)
    with steps.step("token"):
        invited = call(url, trust, Look(token=token), Invited)
    address = options.advertise or address_towards(url) or ""
    with steps.step("certificate"):
        key = new_key()
        asked = Join(
            token=token,
            request=request_for(key),
            address=address,
            follow=options.advertise is None,
            ports=options.ports,
            machine=describe(engine, options.echo),
        )
        issued = _ask_twice(url, trust, asked)
    urls = tuple(dict.fromkeys((*options.urls, *issued.urls)))
    config = NodeConfig(
        name=invited.name,
        urls=urls,
        engine=path,
        address=address,
        follow=options.advertise is None,
        echo=options.echo,
        devices=options.devices,
        registries=options.registries,
        unfiltered=options.unfiltered,
        unit=options.unit,
    )
    try:
        with steps.step("unit" if options.unit else "keys"):
            store.join(config, seen.authority, key, issued.certificate)
            if options.unit:
                unit.install(unit.unit(options.program or unit.own_program(), options.folder, path))
        with steps.step("site"), contextlib.nullcontext() if options.unit else _linked(store):
            stands = _until_there(store, url, by_unit=options.unit)
    except BaseException as error:
        _withdraw(store, url)
        if isinstance(error, OSError):
            raise NodeError(
                f"cannot write to {options.folder}: {error.strerror}; nothing is left of the join"
            ) from error
        raise
    return Joined(invited.name, address, stands, steps.took_s)


def _parts(text: str) -> tuple[str, str]:
    token = text.strip()
    if not _TOKEN.fullmatch(token):
        raise NodeError(
            "this is no join token: it is one word, sky-... with a dot in it, as `skytether site invite NAME` prints it"
        )
    return token, token.partition(".")[2]


def engine_path(engine: str) -> str:
    """Path of an engine's socket.

    Raises:
        NodeError: It is no address of a local engine.
    """
    path = engine.removeprefix("unix://")
    if not path.startswith("/"):
        raise NodeError(f"--engine {engine}: write unix:///PATH; the engine of another machine joins there")
    return path


def _check(
    options: JoinOptions, pin: str, path: str, on_finding: Callable[[Finding], object]
) -> tuple[str, FirstAnswer, EngineInfo | None]:
    found: list[Finding] = []

    def note(finding: Finding) -> None:
        found.append(finding)
        on_finding(finding)

    note(checks.check_rights(options.folder, unit=options.unit))
    finding, engine = checks.check_engine(path)
    note(finding)
    if engine is not None:
        note(checks.judge_memory(engine.memory_mb))
        note(checks.check_disk(engine))
    ports = range(options.ports[0], options.ports[1] + 1) if options.ports else ()
    note(checks.check_ports(ports, options.echo))
    answered, seen = _reach(options.urls, pin, note)
    if seen is not None:
        note(checks.judge_clock(seen.ahead_s))
        named = options.advertise is not None
        address = options.advertise or address_towards(answered)
        if address is None:
            note(
                Finding("address", "this machine has no address towards the orchestrator: give --advertise", good=False)
            )
        else:
            note(checks.judge_address(address, named=named, orchestrator=address_of(answered)[0]))
    bad = [one for one in found if not one.good]
    if bad or seen is None:
        raise ChecksError(bad)
    return answered, seen, engine


def _reach(urls: tuple[str, ...], pin: str, note: Callable[[Finding], object]) -> tuple[str, FirstAnswer | None]:
    """The first orchestrator that answers, and is the one of the token."""
    failure = ""
    for url in urls:
        try:
            seen = first_call(url, pin)
        except UnreachableError as error:
            failure = failure or str(error)
        except NodeError as error:
            failure = str(error)
            break
        else:
            note(Finding("orchestrator", f"{url} is the one that made the token"))
            return url, seen
    note(Finding("orchestrator", failure, good=False))
    return urls[0], None


def _ask_twice(url: str, trust: ssl.SSLContext, asked: Join) -> Issued:
    """An answer may be lost on its way: with the same key the same token is good again."""
    try:
        return call(url, trust, asked, Issued)
    except UnreachableError:
        return call(url, trust, asked, Issued)


def _until_there(store: NodeStore, url: str, *, by_unit: bool = False) -> Stands:
    """Wait until the site answers at the orchestrator; ``by_unit``: a unit of systemd runs the node."""
    began = looked_at = time.monotonic()
    trust, last = trusting(store.authority(), store.identity), ""
    while time.monotonic() < began + _READY_S:
        if by_unit and time.monotonic() >= looked_at + LOOK_S:
            looked_at = time.monotonic()
            if why := unit.trouble():
                last = why
                break
        try:
            stands = call(url, trust, Standing(), Stands)
        except UnreachableError as error:
            last = str(error)
        else:
            if stands.state in ("ready", "blocked"):
                return stands
            last = stands.reason or "the site is gone"
            if stands.state == "gone":
                break
        time.sleep(POLL_S)
    raise NodeError(
        f"the site did not answer within {time.monotonic() - began:.0f} s ({last}); nothing is left of the join, and "
        "the token is used up; `journalctl -u skytether-node` may say more"
    )


@contextmanager
def _linked(store: NodeStore) -> Iterator[None]:
    """Run the node here for a moment."""
    program, loop, echo = NodeProgram(store), asyncio.new_event_loop(), store.config().echo
    task = loop.create_task(program.run())

    def run() -> None:
        with contextlib.suppress(asyncio.CancelledError):
            loop.run_until_complete(task)
        loop.run_until_complete(loop.shutdown_default_executor())
        loop.close()

    thread = threading.Thread(target=run, name="node", daemon=True)
    thread.start()
    try:
        with contextlib.ExitStack() as stack:
            if echo is not None:
                with contextlib.suppress(OSError):  # taken just now: the orchestrator says that nobody answers
                    stack.enter_context(EchoServer("0.0.0.0", echo))  # noqa: S104 (it is for robots)
            yield
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join()


def _withdraw(store: NodeStore, url: str) -> None:
    with contextlib.suppress(NodeError):
        call(url, trusting(store.authority(), store.identity), Leave(force=True), Stands)
    unit.remove()
    store.clear()


def leave(
    store: NodeStore, *, force: bool, timeout_s: float, on_progress: Callable[[str], object] = lambda _: None
) -> str | None:
    """Let this machine be no site any more; what runs here is moved first.

    Args:
        store: Of the node.
        force: At once, whatever runs here, and also where no orchestrator answers.
        timeout_s: For what runs here to be moved.
        on_progress: Called with how far it is, and with what is on this machine still.

    Returns:
        What is left to be done elsewhere; None: nothing.

    Raises:
        NodeError: It did not work; the machine is a site still.
    """
    left: str | None = None
    engine = ""
    try:
        config = store.config()
        engine = config.engine
        _leave(config, store, force=force, timeout_s=timeout_s, on_progress=on_progress)
    except NodeError as error:
        if not force:
            raise
        left = str(error)
    unit.remove()
    store.clear()
    if still := _still_here(engine):
        on_progress(still)
    return left


def _still_here(engine: str) -> str:
    """Containers that orchestrators made, which may be of one that others have taken, and says that it has ended them.

    Not removed by us: another orchestrator may use the same engine.
    """
    asked = urlencode({"all": "1", "filters": json.dumps({"label": [OWNER]})})
    try:
        found = json.loads(ask(engine, f"/containers/json?{asked}", most=_MOST_LIST).content)
        count = f"{len(found)} containers that orchestrators made are" if found else ""
    except (OSError, ValueError):
        count = "containers that orchestrators made may be"
    docker = "docker" if engine in ("", LOCAL_SOCKET) else f"docker -H unix://{engine}"
    removes = f"{docker} rm -fv $({docker} ps -aq --filter label={OWNER})"
    return f"{count} here still, and run on: `{removes}` ends them" if count else ""


def _leave(
    config: NodeConfig, store: NodeStore, *, force: bool, timeout_s: float, on_progress: Callable[[str], object]
) -> None:
    trust = trusting(store.authority(), store.identity)
    deadline, told = time.monotonic() + timeout_s, ""
    while True:
        stands = _ask_any(config, trust, Leave(force=force))
        if stands.state == "gone":
            return
        here = f"{stands.instances} instances are here still" if stands.instances else ""
        text = ": ".join(filter(None, (here, stands.reason))) or "the site goes"
        if text != told:
            on_progress(text)
            told = text
        if time.monotonic() >= deadline:
            raise NodeError(
                f"{text}; nothing else takes them, perhaps: `skytether instance list` says why. They stay, and so does "
                "the site; with --force it ends with them"
            )
        time.sleep(LEFT_S)


def _ask_any(config: NodeConfig, trust: ssl.SSLContext, asked: Leave) -> Stands:
    failure: NodeError | None = None
    for url in config.urls:
        try:
            return call(url, trust, asked, Stands)
        except RefusedError:
            raise
        except UnreachableError as error:
            failure = error
    raise NodeError(
        f"{failure}; with --force this machine leaves without a word: then remove the site there, "
        f"`skytether site remove {config.name} --force`"
    )
