"""Nodes and orchestrators that are updated one after the other, as docs/nodes.md says, under robots that are driven.

All of it is real: programs, containers of this machine's engine, robots' agents at 100 Hz. Only `ssh` is played: what
is asked of a node there is done here.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from docker_site import DockerSite, Images
from newer_code import newer_code
from orchestrator_program import Program, until

from skytether.api.client import ApiError, Client, Unreachable
from skytether.api.rest import Instance, Invite, RobotCreate, State
from skytether.lab.bench.migrate import Commands, instance_of
from skytether.lab.demo import WalkerHardware
from skytether.lab.trail import Trail
from skytether.lab.walk import World
from skytether.orchestrator.store.engine import make_engine, migrate
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig
from skytether.robot.control.command import Source

pytestmark = [pytest.mark.slow, pytest.mark.docker, pytest.mark.postgres]

PAGE = Path(__file__).parents[2] / "docs" / "nodes.md"
SERVICE = "virtual-trail"
NEWER = "0.1.0+newer"
BROKEN_S = 2.0
"""Nobody is without commands for so long who is handed over; to start a container takes longer."""
SSH = """#!/bin/sh
# Has the test do on the node what is asked, and waits for it.
printf '%s\\n' "$@" >{folder}/asked.new && mv {folder}/asked.new {folder}/asked
while [ -e {folder}/asked ]; do sleep 0.1; done
"""


def documented() -> tuple[str, list[str]]:
    """The commands of the page, and the nodes that they are for."""
    (block,) = (b for b in PAGE.read_text().split("```")[1::2] if b.lstrip().startswith("for node in"))
    named = re.search(r"for node in (.*); do", block)
    assert named is not None
    return block, named[1].split()


class Node:
    """A machine that joined: its folder, its site on this machine's engine, and its program."""

    def __init__(self, name: str, folder: Path, images: Images) -> None:
        self.name = name
        self.folder = folder / f"node-{name}"
        self.site = DockerSite(images)
        self.program: subprocess.Popen[bytes] | None = None

    def join(self, operator: Client, urls: list[str]) -> None:
        options = {key: value for key, value in self.site.options().items() if key != "engine"}
        words = ["site", "join", ",".join(urls), "--token-file", "-", "--folder", str(self.folder), "--no-unit"]
        token = operator.invite(Invite(name=self.name, options=options)).token
        command = [sys.executable, "-m", "skytether.cli", *words, "--advertise", "127.0.0.1", "--echo-port", "0"]
        done = subprocess.run(command, input=token, text=True, capture_output=True)
        assert done.returncode == 0, done.stderr

    def start(self, code: Path | None = None) -> None:
        path = {"PYTHONPATH": os.pathsep.join(filter(None, (str(code or ""), os.environ.get("PYTHONPATH"))))}
        with self.folder.with_suffix(".log").open("ab") as log:
            command = [sys.executable, "-m", "skytether.cli", "site", "run", "--folder", str(self.folder)]
            self.program = subprocess.Popen(command, stdout=log, stderr=log, env={**os.environ, **path})

    def stop(self) -> None:
        if self.program is not None:
            self.program.send_signal(signal.SIGTERM)
            self.program.wait(60)
            self.program = None


class Watch:
    """Looks at all instances again and again; keeps what must not be."""

    def __init__(self, client: Client, robots: list[str]) -> None:
        self.seen: dict[str, Instance] = {}
        self.wrong: list[str] = []
        self.looks = 0
        self._client, self._robots = client, robots
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._over.wait(0.05):
            try:
                found = self._client.instances()
            except Unreachable:
                continue
            except ApiError as error:
                if error.problem.status != 503:
                    self.wrong.append(str(error))
                continue
            self.looks += 1
            self.seen |= {one.id: one for one in found}
            for robot in self._robots:
                mine = [one for one in found if one.robot == robot]
                if all(one.state is not State.RUNNING for one in mine):
                    self.wrong.append(f"{robot} has none: {[(one.id, one.state, one.reason) for one in mine]}")
                self.wrong += [f"{one.id} was restarted" for one in mine if one.restarts]

    def end(self) -> None:
        self._over.set()
        self._thread.join()


@pytest.fixture
def pair(tmp_path: Path, postgres: str) -> Iterator[list[Program]]:
    (tmp_path / "secrets").mkdir(mode=0o700)
    ports = free_ports(4)
    urls = [f"https://127.0.0.1:{port}" for port in ports[2:]]
    programs = []
    for port, nodes in zip(ports[:2], ports[2:], strict=True):
        (tmp_path / str(port)).mkdir()
        shared = ("--database", postgres, "--secrets-dir", str(tmp_path / "secrets"), "--port", str(port))
        program = Program(tmp_path / str(port) / "state", *shared)
        program.environment = {
            "SKYTETHER_NODES_PORT": str(nodes),
            "SKYTETHER_NODES_URLS": json.dumps(urls),
            "SKYTETHER_LOCAL_SITE": "false",
        }
        programs.append(program)
    yield programs
    for program in programs:
        program.clean_up()


def free_ports(count: int) -> list[int]:
    import socket

    with ExitStack() as stack:
        return [stack.enter_context(socket.create_server(("127.0.0.1", 0))).getsockname()[1] for _ in range(count)]


@pytest.fixture
def newer(tmp_path: Path, postgres: str) -> Path:
    """A later version of all of it, with another schema of the database."""
    engine = make_engine(postgres)
    root = newer_code(tmp_path / "newer", migrate(engine))
    engine.dispose()
    file = root / "skytether/__init__.py"
    file.write_text(re.sub(r'__version__ = ".*"', f'__version__ = "{NEWER}"', file.read_text()))
    return root


@pytest.fixture
def nodes(tmp_path: Path, docker_images: Images) -> Iterator[list[Node]]:
    made = [Node(name, tmp_path, docker_images) for name in documented()[1]]
    yield made
    for node in made:
        node.stop()
        node.site.close()


def start(program: Program) -> None:
    program.spawn()
    until(lambda: (program.folder / "address").exists() and (program.folder / "nodes.address").exists(), program)


def replace(program: Program, code: Path) -> None:
    assert program.end() == 0
    program.code = code
    start(program)


def walker(stack: ExitStack, url: str, operator: Client, name: str) -> tuple[Agent, Commands]:
    token = operator.create_robot(RobotCreate(name=name, services=(SERVICE,))).token
    config = AgentConfig(name, url, SERVICE, token, bind=("127.0.0.1", 0), renew_s=0.5)
    seen = Commands()
    agent = stack.enter_context(Agent(config, WalkerHardware(World(Trail(), seed=1)), observer=seen))
    return agent, seen


def test_two_nodes_and_two_orchestrators_are_updated_as_documented_and_no_robot_notices(
    pair: list[Program], nodes: list[Node], newer: Path, docker_images: Images, tmp_path: Path
) -> None:
    one, two = pair
    start(one)
    start(two)
    urls = [program.environment["SKYTETHER_NODES_URLS"] for program in pair]
    assert urls[0] == urls[1]
    address = ",".join(f"http://127.0.0.1:{program.options[-1]}" for program in pair)
    token = (tmp_path / "secrets/operator.token").read_text().strip()
    with ExitStack() as stack:
        operator, eye = (stack.enter_context(Client(address, token, timeout=60)) for _ in range(2))
        manifest = operator.get_service(SERVICE)
        spec = manifest.spec.model_copy(update={"image": docker_images.name(SERVICE)})
        operator.put_service(SERVICE, manifest.model_copy(update={"spec": spec}))
        for node in nodes:
            node.join(operator, json.loads(urls[0]))
            node.start()
        until(lambda: all(site.state == "ready" for site in operator.sites()), one)
        robots = ["first", "second"]
        driven = [walker(stack, address, operator, name) for name in robots]
        until(lambda: all(agent.source is Source.CLOUD for agent, _ in driven), one)
        before = [instance_of(agent) for agent, _ in driven]
        began = time.monotonic()
        watch = Watch(eye, robots)
        try:
            replace(one, newer)  # as docs/operating.md says; the other one leads meanwhile
            roll(nodes, newer, address, tmp_path, lambda: replace(two, newer))
            after = [instance_of(agent) for agent, _ in driven]
            until(lambda: all(agent.source is Source.CLOUD for agent, _ in driven), one)
        finally:
            watch.end()
        gaps = [seen.longest_gap_ms(began, time.monotonic()) for _, seen in driven]
        assert watch.wrong == []
        assert watch.looks > 20
        assert not {*before} & {*after}
        assert max(gaps) < BROKEN_S * 1e3
        moved = [one for one in watch.seen.values() if one.robot in robots]
        assert len(moved) >= 2 * len(robots)  # the second node's were at the first one before, whatever was there first
        sites = {site.name: site for site in operator.sites()}
        assert {sites[node.name].node.version for node in nodes if sites[node.name].node} == {NEWER}  # type: ignore[union-attr]
        assert [sites[node.name].instances for node in nodes] == [2, 0]
        assert not any(site.evacuating for site in sites.values())
    for program in pair:
        assert "Traceback" not in program.log


def roll(nodes: list[Node], newer: Path, address: str, folder: Path, meanwhile: Callable[[], object]) -> None:
    """Run the commands of the page; after the first node something else is done too."""
    (folder / "bin").mkdir()
    for name, text in (
        ("skytether", f'#!/bin/sh\nexec "{sys.executable}" -m skytether.cli "$@"\n'),
        ("ssh", SSH.format(folder=folder)),
    ):
        (folder / "bin" / name).write_text(text)
        (folder / "bin" / name).chmod(0o755)
    environment = {
        **os.environ,
        "PATH": f"{folder}/bin:{os.environ['PATH']}",
        "SKYTETHER_URL": address,
        "SKYTETHER_TOKEN_FILE": str(folder / "secrets/operator.token"),
    }
    asked = folder / "asked"
    rolling = subprocess.Popen(["bash", "-c", documented()[0]], env=environment, stderr=subprocess.PIPE, text=True)
    assert rolling.stderr is not None
    try:
        for node in nodes:
            until(lambda: asked.exists() or rolling.poll() is not None)
            assert asked.exists(), rolling.stderr.read()
            where, what = asked.read_text().splitlines()
            assert where == f"root@{node.name}"
            assert what.endswith("systemctl restart skytether-node")
            running = node.site.labelled("skytether.io/instance", "status=running")
            assert running == [], "an engine that is restarted now ends nobody's service"
            node.stop()
            node.start(newer)
            asked.unlink()
            if node is nodes[0]:
                meanwhile()
        _, said = rolling.communicate(timeout=120)
    finally:
        asked.unlink(missing_ok=True)
        with contextlib.suppress(ProcessLookupError):
            rolling.kill()
        rolling.wait()
    assert rolling.returncode == 0, said
    told: list[Any] = re.findall(r"site (\w+) takes (no more|instances)", said)
    assert told == [(node.name, words) for node in nodes for words in ("no more", "instances")], said
