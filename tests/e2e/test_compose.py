"""compose.yaml for real: orchestrator, PostgreSQL, Prometheus, an instance on the engine, every query of the dashboard.

Prometheus and PostgreSQL are this machine's own programs in containers with the users, folders and rights that
compose.yaml gives them; there is no Grafana here, so what it shows is asked of Prometheus.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
from docker_site import DockerSite, Images

from skytether.api.client import Client
from skytether.api.groups import GroupCreate
from skytether.api.manifest import Manifest
from skytether.api.rest import (
    GateReport,
    InstanceCreate,
    Invite,
    Renew,
    Report,
    Resize,
    RobotCreate,
    SiteCreate,
    TopicReport,
)
from skytether.node.join import JoinOptions, join
from skytether.node.store import NodeStore

pytestmark = [pytest.mark.slow, pytest.mark.docker, pytest.mark.compose]

ROOT = Path(__file__).parents[2]
SUPPORT = ROOT / "tests" / "support" / "compose"
MORE = [ROOT / f"images/orchestrator/{name}.yaml" for name in ("engine-local", "nodes")]
FILES = [ROOT / "compose.yaml", *MORE, SUPPORT / "stand-ins.yaml"]
PATIENCE = 120.0
STARTED = ("passwords", "postgres", "orchestrator", "token", "prometheus")


def run(*command: str, **more: Any) -> str:
    done = subprocess.run(command, capture_output=True, text=True, **more)
    assert done.returncode == 0, f"{' '.join(command)}: {done.stdout}{done.stderr}"
    return done.stdout.strip()


def until(condition: Callable[[], Any]) -> Any:
    deadline = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < deadline
        time.sleep(0.2)
    return found


@dataclass
class Stack:
    """All of compose.yaml but Grafana."""

    project: str
    environment: dict[str, str]

    def compose(self, *arguments: str) -> str:
        files = [part for file in FILES for part in ("-f", str(file))]
        return run("docker-compose", "-p", self.project, *files, *arguments, env=self.environment, cwd=ROOT)

    def container(self, service: str) -> str:
        return f"{self.project}_{service}_1"

    def show(self, service: str, form: str) -> str:
        return run("docker", "inspect", "-f", form, self.container(service))

    def inside(self, service: str, *command: str) -> str:
        return run("docker", "exec", self.container(service), *command)

    @property
    def client(self) -> Client:
        port = run("docker", "port", self.container("orchestrator"), "8600/tcp")
        assert port.startswith("127.0.0.1:")
        token = self.inside("orchestrator", "cat", "/var/lib/skytether/operator.token")
        return Client(f"http://{port}", token.strip())

    def query(self, expression: str) -> list[dict[str, Any]]:
        """What Prometheus answers; it is not published, but the machine reaches its containers."""
        address = self.show("prometheus", "{{range .NetworkSettings.Networks}}{{.IPAddress}}{{end}}")
        url = f"http://{address}:9090/api/v1/query"
        answer = httpx.post(url, data={"query": expression}, trust_env=False, timeout=10).json()
        assert answer["status"] == "success", (expression, answer)
        found: list[dict[str, Any]] = answer["data"]["result"]
        return found


@pytest.fixture(scope="module")
def often(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The configuration of Prometheus, which asks each second."""
    folder = Path(shutil.copytree(ROOT / "images/prometheus", tmp_path_factory.mktemp("prometheus") / "often"))
    folder.chmod(0o755)
    file = folder / "prometheus.yml"
    text, changed = re.subn(r"(\w+_interval): \d+s", r"\1: 1s", file.read_text())
    assert changed == 3
    file.write_text(text)
    return folder


@pytest.fixture(scope="module")
def stack(compose_programs: None, docker_images: Images, often: Path) -> Iterator[Stack]:
    """Started as an operator starts it."""
    project = f"skytether-test-{secrets.token_hex(4)}"
    build = [sys.executable, str(ROOT / "images" / "build.py"), "--prefix", docker_images.prefix, "orchestrator"]
    run(*build)
    stand_in = f"{project}:1"
    run("docker", "build", "-q", "-t", stand_in, str(SUPPORT), env={**os.environ, "DOCKER_BUILDKIT": "0"})
    stack = Stack(
        project,
        {
            **os.environ,
            "SKYTETHER_IMAGE": docker_images.name("orchestrator"),
            "SKYTETHER_PORT": "0",
            "SKYTETHER_NODES_URL": "https://192.0.2.7:8603",
            "SKYTETHER_NODES_ADDRESS": "127.0.0.1",
            "SKYTETHER_NODES_PORT": "0",
            "STAND_IN": stand_in,
            "OFTEN": str(often),
            "DOCKER_GID": str(Path("/var/run/docker.sock").stat().st_gid),
        },
    )
    try:
        stack.compose("up", "-d", "prometheus")
        yield stack
    finally:
        stack.compose("down", "--volumes", "--timeout", "2")
        run("docker", "image", "rm", "-f", stand_in)
        docker_images.remove("orchestrator")


@pytest.mark.parametrize("service", STARTED)
def test_containers_have_no_rights(stack: Stack, service: str) -> None:
    shown = json.loads(run("docker", "inspect", stack.container(service)))[0]
    host = shown["HostConfig"]
    assert host["ReadonlyRootfs"]
    assert host["CapDrop"] == ["ALL"]
    assert host["SecurityOpt"] == ["no-new-privileges:true"]
    assert int(shown["Config"]["User"].split(":")[0]) > 0
    published = [way["HostIp"] for ways in (host["PortBindings"] or {}).values() for way in ways]
    assert set(published) == ({"127.0.0.1"} if service == "orchestrator" else set())


def test_the_first_start_is_the_only_one_that_makes_secrets(stack: Stack) -> None:
    for service in ("passwords", "token"):
        assert stack.show(service, "{{.State.ExitCode}}") == "0"
        assert "made /secrets/" in run("docker", "logs", stack.container(service))
        again = run("docker", "start", "--attach", stack.container(service))
        assert again.count("made /secrets/") == 0, again


def test_the_orchestrator_is_at_home_in_its_container(stack: Stack) -> None:
    assert stack.inside("orchestrator", "stat", "-c", "%a %U", "/var/lib/skytether") == "700 skytether"
    assert json.loads(stack.inside("orchestrator", "skytether", "site", "list", "--json")) == []
    stack.inside("orchestrator", "ssh", "-G", "edge.example")  # it refuses a user that it does not know


def test_a_machine_joins_by_the_port_that_is_published_for_it(
    stack: Stack, docker_site: DockerSite, tmp_path: Path
) -> None:
    port = run("docker", "port", stack.container("orchestrator"), "8603/tcp").rpartition(":")[2]
    options = {key: value for key, value in docker_site.options().items() if key != "engine"}
    with stack.client as client:
        token = client.invite(Invite(name="ward", options=options)).token
        urls = (f"https://127.0.0.1:{port}",)
        store = NodeStore(tmp_path / "node")
        joined = join(JoinOptions(urls, token, advertise="127.0.0.1", echo=None, folder=store.folder, unit=False))
        assert joined.stands.state == "ready", joined.stands.reason
        assert "https://192.0.2.7:8603" in store.config().urls
        assert client.delete_site("ward", force=True)
    assert stack.inside("orchestrator", "stat", "-c", "%a", "/var/lib/skytether/nodes.key") == "600"


def test_machines_can_be_made_at_a_cloud_without_a_package_more(stack: Stack) -> None:
    """The image has openstacksdk, with what that finds by entry points: it asks a cloud, which is not there."""
    auth = {"auth_url": "http://127.0.0.1:9/v3", "application_credential_id": "i", "application_credential_secret": "s"}
    clouds = {"clouds": {"lab": {"auth_type": "v3applicationcredential", "auth": auth, "region_name": "r"}}}
    for name, text in (("clouds.yaml", json.dumps(clouds)), ("machine.yaml", "#cloud-config @SKYTETHER_TOKEN@")):
        stack.inside("orchestrator", "sh", "-c", f"umask 077; printf %s '{text}' >/tmp/{name}")
    named = {"cloud": "lab", "clouds_file": "/tmp/clouds.yaml", "user_data": "/tmp/machine.yaml"}
    options = {**named, "flavor": "f", "image": "i", "network": "n"}
    with stack.client as client:
        made = client.create_group(GroupCreate(name="far", provider="openstack", max=1, options=options))
        assert "cloud 'lab' does not answer" in made.reason
        assert client.delete_group("far")


def test_the_database_can_be_copied(stack: Stack) -> None:
    copied = stack.inside("postgres", "pg_dump", "--username=skytether", "--data-only", "--table=tokens", "skytether")
    assert "prometheus" in copied


def test_the_configuration_is_good_for_prometheus(stack: Stack) -> None:
    stack.inside("prometheus", "promtool", "check", "config", "/etc/prometheus/prometheus.yml")


def test_alerts_are_raised_by_what_they_say(compose_programs: None) -> None:
    run("promtool", "test", "rules", str(SUPPORT / "rules_test.yml"))


def test_what_is_missing_is_told(compose_programs: None) -> None:
    for name, variable in (
        ("engine-local", "DOCKER_GID"),
        ("engine-remote", "SKYTETHER_ENGINES"),
        ("nodes", "SKYTETHER_NODES_URL"),
    ):
        command = [
            "docker-compose",
            "-f",
            str(FILES[0]),
            "-f",
            str(ROOT / f"images/orchestrator/{name}.yaml"),
            "config",
            "-q",
        ]
        without = {key: value for key, value in os.environ.items() if key != variable}
        done = subprocess.run(command, capture_output=True, text=True, env=without)
        assert done.returncode == 1
        assert f"set {variable} to" in done.stderr
        run(*command, env={**os.environ, variable: "/1"})


def report(n: int) -> Report:
    """What a robot tells after ``n`` renewals."""
    topics = [
        TopicReport(
            topic=name,
            direction=direction,
            priority=100,
            sent=100 * n,
            delivered=99 * n,
            lost=n,
            bytes_sent=9000 * n,
            delay_p50_s=0.02,
            delay_p99_s=0.05,
            jitter_s=0.001,
        )
        for name, direction in (("force", "in"), ("cmd_vel", "out"))
    ]
    return Report(
        rtt_s=0.04,
        topics=tuple(topics),
        control_source="cloud",
        fallback_transitions={"delay": n},
        objections={"late": n},
        load=0.3,
        battery=0.8,
        overruns=n,
        gate=GateReport(answers=True, stopped="somebody fell", troubles=1),
    )


def asked() -> list[str]:
    """Every query of the dashboard, as Grafana would send it."""
    dashboard = json.loads((ROOT / "images/grafana/dashboards/skytether.json").read_text())
    targets = [target["expr"] for panel in dashboard["panels"] for target in panel.get("targets", ())]
    for name, value in (("$__rate_interval", "1m"), ("$robot", ".*"), ("$site", ".*")):
        targets = [target.replace(name, value) for target in targets]
    assert not any("$" in target for target in targets)
    return targets


def test_an_instance_runs_and_prometheus_knows_all_that_the_dashboard_asks(
    stack: Stack, docker_site: DockerSite
) -> None:
    images = docker_site.images
    with stack.client as client:
        # A process site, in the orchestrator's own container, knows its load; it cannot run what is an image only.
        client.create_site(SiteCreate(name="here", tier="edge", runtime="process"))
        options = docker_site.options(bind_host="127.0.0.1")
        client.create_site(SiteCreate(name="edge", tier="edge", runtime="docker", options=options))
        document = {"apiVersion": "skytether.io/v1", "kind": "Service", "metadata": {"name": "virtual-trail"}}
        topics = [{"name": n, "type": "a/msg/B", "direction": d} for n, d in (("force", "in"), ("cmd_vel", "out"))]
        spec = {"image": images.toy, "topics": topics, "states": ["said"], "params": {"additionalProperties": True}}
        client.put_service("virtual-trail", Manifest.model_validate({**document, "spec": spec}))
        client.create_robot(RobotCreate(name="walker"))  # of a robot that nobody registered no gate is kept
        asked_for = {"robot": "walker", "service": "virtual-trail", "lease_s": 600, "params": {"report": "at work"}}
        made = client.create_instance(InstanceCreate.model_validate(asked_for))
        assert client.wait_running(made.id, timeout=PATIENCE).placement.site == "edge"
        client.resize_instance(made.id, Resize(cpu=0.75))
        client.create_group(GroupCreate(name="more", provider="local", tier="edge", max=1))
        until(lambda: len(stack.query("up == 1")) == 2)
        assert [row["metric"]["instance"] for row in stack.query('up{job="skytether"}')] == ["orchestrator:8600"]

        renewals = 0

        def missing() -> list[str]:
            nonlocal renewals
            renewals += 1
            client.renew_instance(made.id, Renew(report=report(renewals)))
            return [expression for expression in asked() if not stack.query(expression)]

        deadline = time.monotonic() + PATIENCE
        while left := missing():
            assert time.monotonic() < deadline, left
            time.sleep(0.5)
        (driven,) = stack.query('skytether_control_source{robot="walker", source="cloud"}')
        assert driven["value"][1] == "1"

        client.delete_instance(made.id)
        # Series vanish with what they describe; what it has written is there still.
        until(
            lambda: (
                not stack.query('{__name__=~"skytether_.+", __name__!="skytether_robot_data_bytes", robot="walker"}')
            )
        )
        assert stack.query('skytether_robot_data_bytes{robot="walker"}')
        assert stack.query("skytether_site_up")
        client.delete_site("edge")  # the stack outlives it, and would go on to keep what marks its leader there
