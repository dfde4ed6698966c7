"""What the module `node` renders does what it says: its firewall in a kernel, scripts and units by their checkers."""

from __future__ import annotations

import json
import os
import select
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import yaml
from networks import cable, nft
from terraform_runs import Terraform, copied

from skytether.lab.netns import Namespace

pytestmark = pytest.mark.slow

ROBOT, OPERATOR, NODE = "192.0.2.9", "192.0.2.10", "192.0.2.1"
PATIENCE_S = 0.5
VARIABLES: dict[str, Any] = {
    "name": "ward-3",
    "orchestrator": "https://cloud.example.org",
    "ssh_from": [f"{OPERATOR}/32"],
    "package": {"source": "/opt/wheels/skytether-0.1.0-py3-none-any.whl", "options": ["--no-index"]},
    "images": ["/opt/images.tar"],
    "token_command": "cat /etc/hostname",
    "reboot_at": "03:30",
}


@pytest.fixture(scope="module")
def terraform(terraform_program: str, tmp_path_factory: pytest.TempPathFactory) -> Terraform:
    return copied(terraform_program, tmp_path_factory.mktemp("node"))


@pytest.fixture(scope="module")
def files(terraform: Terraform) -> dict[str, Any]:
    """What cloud-init writes, by path."""
    folder = terraform.initialised("modules/node").tree / "terraform/modules/node"
    (folder / "test.auto.tfvars.json").write_text(json.dumps(VARIABLES))
    done = terraform.run("modules/node", "apply", "-auto-approve", "-input=false", "-no-color")
    assert done.returncode == 0, done.stderr
    outputs = json.loads(terraform.run("modules/node", "output", "-json").stdout)
    document = yaml.safe_load(outputs["user_data"]["value"])
    assert document["runcmd"] == [["/usr/local/sbin/skytether-setup"]]
    return {one["path"]: one for one in document["write_files"]}


def test_scripts_are_scripts(files: dict[str, Any]) -> None:
    scripts = {path: one for path, one in files.items() if one["content"].startswith("#!")}
    assert len(scripts) == 3
    for path, one in scripts.items():
        assert one["permissions"] in ("0755", "0700"), path
        shell = one["content"].partition("\n")[0].removeprefix("#!")
        done = subprocess.run([shell, "-n"], input=one["content"], capture_output=True, text=True, check=False)
        assert done.returncode == 0, (path, done.stderr)


def test_units_are_units(files: dict[str, Any], tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is missing")
    for path, one in files.items():
        if path.endswith(".service"):
            unit = tmp_path / Path(path).name
            # What they start is on the node, not here.
            unit.write_text(one["content"].replace("/usr/sbin/nft", "/bin/true").replace("/usr/local/sbin/", "/bin/"))
            command = ["systemd-analyze", "verify", "--man=no", "--recursive-errors=no", str(unit)]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            assert unit.name not in done.stderr, done.stderr


@pytest.fixture
def world(nftables: None, files: dict[str, Any]) -> Iterator[dict[str, Namespace]]:
    """A node with its firewall, a robot and an operator before it, and a container at its engine's bridge."""
    with ExitStack() as stack:
        names = ("node", "robot", "operator", "container")
        here = {name: stack.enter_context(Namespace()) for name in names}
        node = here["node"]
        node.ip("link", "add", "lan", "type", "bridge")
        node.ip("address", "add", f"{NODE}/24", "dev", "lan")
        node.ip("link", "set", "lan", "up")
        for name, address in (("robot", ROBOT), ("operator", OPERATOR)):
            cable(node, here[name], (f"to-{name}", "10.0.0.1/32"), ("eth0", f"{address}/24"))
            node.ip("link", "set", f"to-{name}", "master", "lan")
        cable(node, here["container"], ("br-engine", "172.18.0.1/16"), ("eth0", "172.18.0.2/16"))
        here["container"].ip("route", "add", "default", "via", "172.18.0.1")
        node.sysctl("net.ipv4.ip_forward", "1")
        here["robot"].ip("route", "add", "172.18.0.0/16", "via", NODE)
        # As an engine publishes ports: session 20001, and one that somebody published by hand.
        nft(
            node,
            """table ip engine {
              chain pre {
                type nat hook prerouting priority dstnat;
                udp dport 20001 dnat to 172.18.0.2:7000
                udp dport 30001 dnat to 172.18.0.2:7000
                tcp dport 8080 dnat to 172.18.0.2:7000
              }
            }""",
        )
        nft(node, files["/etc/skytether/firewall.nft"]["content"])
        nft(node, files["/etc/skytether/firewall.nft"]["content"])  # loaded anew, it is the same
        yield here


def udp_arrives(source: Namespace, address: str, port: int, target: Namespace, inside: int | None = None) -> bool:
    """Whether a datagram is received by a socket in the target."""

    def listening() -> socket.socket:
        listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        listener.bind(("0.0.0.0", inside or port))
        return listener

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(b"hello", (address, port))

    with target.run(listening) as listener:
        source.run(send)
        return bool(select.select([listener], [], [], PATIENCE_S)[0])


def tcp_connects(source: Namespace, address: str, port: int, target: Namespace, inside: int | None = None) -> bool:
    """Whether a connection comes about."""
    with target.run(lambda: socket.create_server(("0.0.0.0", inside or port))):

        def connect() -> bool:
            try:
                socket.create_connection((address, port), PATIENCE_S).close()
            except OSError:
                return False
            return True

        return source.run(connect)


def test_the_firewall_opens_sessions_echo_and_ssh_for_its_operators_and_nothing_else(
    world: dict[str, Namespace],
) -> None:
    node, robot, operator = world["node"], world["robot"], world["operator"]
    assert udp_arrives(robot, NODE, 20000, node)
    assert udp_arrives(robot, NODE, 20099, node)
    assert udp_arrives(robot, NODE, 8600, node)
    assert not udp_arrives(robot, NODE, 19999, node)
    assert not udp_arrives(robot, NODE, 20100, node)
    assert not tcp_connects(robot, NODE, 20000, node)
    assert tcp_connects(operator, NODE, 22, node)
    assert not tcp_connects(robot, NODE, 22, node)
    assert not tcp_connects(operator, NODE, 2375, node)
    assert tcp_connects(node, ROBOT, 8603, robot)  # the node calls whom it likes


def test_what_an_engine_publishes_is_opened_no_wider(world: dict[str, Namespace]) -> None:
    robot, container = world["robot"], world["container"]
    assert udp_arrives(robot, NODE, 20001, container, 7000)
    assert not udp_arrives(robot, NODE, 30001, container, 7000)
    assert not tcp_connects(robot, NODE, 8080, container, 7000)
    assert not udp_arrives(robot, "172.18.0.2", 7000, container)  # nor by the container's own address
    assert udp_arrives(container, ROBOT, 7000, robot)


def test_no_container_reads_the_clouds_metadata(world: dict[str, Namespace]) -> None:
    node, robot, container = world["node"], world["robot"], world["container"]
    robot.ip("address", "add", "169.254.169.254/32", "dev", "lo")
    node.ip("route", "add", "169.254.169.254/32", "via", ROBOT)
    container_reaches = tcp_connects(container, "169.254.169.254", 80, robot)
    assert not container_reaches
    assert tcp_connects(node, "169.254.169.254", 80, robot)


def test_the_join_takes_its_token_from_a_pipe_and_says_why_a_setup_failed(
    files: dict[str, Any], tmp_path: Path
) -> None:
    if os.geteuid() != 0:
        pytest.skip("the script wants to be root")
    seen = tmp_path / "seen"
    program = tmp_path / "skytether"
    program.write_text(f'#!/bin/sh\nprintf "%s\\n" "$*" >{seen}\ncat >>{seen}\n')
    program.chmod(0o755)
    setup, log = tmp_path / "setup", tmp_path / "setup.log"
    script = files["/usr/local/sbin/skytether-join"]["content"]
    for path, there in (
        ("/opt/skytether/bin/skytether", program),
        ("/var/lib/skytether-setup", setup),
        ("/var/log/skytether-setup.log", log),
    ):
        assert path in script
        script = script.replace(path, str(there))

    def join(text: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(["sh", "-c", script], input=text, capture_output=True, text=True, check=False, timeout=20)

    setup.write_text("0\n")
    assert join("sky-secret.pin\n").returncode == 0
    words, token = seen.read_text().splitlines()
    assert token == "sky-secret.pin"
    assert words == "site join https://cloud.example.org --ports 20000-20099 --echo-port 8600 --token-file -"
    assert "no token on standard input" in join("").stderr
    setup.write_text("100\n")
    log.write_text("E: Unable to locate package docker.io\n")
    failed = join("sky-secret.pin\n")
    assert failed.returncode == 1
    assert "Unable to locate package" in failed.stderr
