"""A machine that joined, with a real engine: containers are started by way of it, and outlive a pulled cable."""

from __future__ import annotations

import io
import json
import subprocess
import tarfile
from collections.abc import Callable, Iterator
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from docker.errors import APIError
from docker_site import DockerSite
from node_scene import NodeScene, program, until
from registry_server import registry

from skytether.api.client import Client
from skytether.api.rest import InstanceCreate, Invite, State
from skytether.node.join import join
from skytether.orchestrator.config.settings import Nodes, Settings, Timing
from skytether.orchestrator.core import Orchestrator
from skytether.orchestrator.http.app import create_app
from skytether.orchestrator.runtimes.docker.client import Client as Engine
from skytether.orchestrator.runtimes.docker.objects import READY, holder
from skytether.orchestrator.runtimes.docker.options import DockerOptions

pytestmark = [pytest.mark.docker, pytest.mark.slow]

ENGINE = "unix:///var/run/docker.sock"


@pytest.fixture
def house(tmp_path: Path, server: Any, docker_site: DockerSite, manifest: Callable[..., Any]) -> Iterator[NodeScene]:
    settings = Settings(state_dir=tmp_path / "state", nodes=Nodes(port=0), timing=Timing(site_silent=5))
    core = Orchestrator(settings)
    core.start()
    core.sites.delete("local")
    server.app = create_app(core)
    server.share_routes()
    with Client(server.url, (tmp_path / "state/operator.token").read_text().strip()) as operator:
        operator.put_service("toy", manifest(entrypoint=None, image=docker_site.images.toy))
        scene = NodeScene(core, operator, tmp_path)
        yield scene
        scene.close()
    core.stop()


def test_what_runs_at_a_node_that_is_unplugged_runs_on_and_is_found_again(
    house: NodeScene, docker_site: DockerSite
) -> None:
    options = {key: value for key, value in docker_site.options().items() if key != "engine"}
    token = house.operator.invite(Invite(name="edge", options=options)).token
    joined = join(house.options(token, engine=ENGINE))
    assert joined.stands.state == "ready", joined.stands.reason
    with program(house.store()) as linked:
        until(lambda: linked and house.state() == "ready")
        made = house.operator.create_instance(InstanceCreate(robot="walker", service="toy", lease_s=1000))
        before = house.operator.wait_running(made.id)
        assert before.session is not None
        assert before.session.host == "127.0.0.1"
        (container,) = docker_site.containers()
        began = docker_site.docker("inspect", "-f", "{{.State.StartedAt}}", container)
        assert house.operator.logs(made.id)
        refuses_to_be_had(house, docker_site, container)
        house.shut()
        until(lambda: house.state() == "unreachable")
        assert docker_site.docker("inspect", "-f", "{{.State.Running}}", container) == "true"
        house.open()
        until(lambda: house.state() == "ready")
        after = house.operator.renew_instance(made.id)
        assert (after.state, after.restarts) == (State.RUNNING, 0)
        assert docker_site.docker("inspect", "-f", "{{.State.StartedAt}}", container) == began
        house.operator.delete_instance(made.id)
        until(lambda: not house.operator.get_site("edge").instances)
        # By way of the node what is left there goes with the site.
        assert house.operator.delete_site("edge")
        assert docker_site.containers() == docker_site.helpers() == []


def test_what_is_pulled_by_a_name_gets_that_name_at_no_engine(
    house: NodeScene, docker_site: DockerSite, registry_program: str, tmp_path: Path, manifest: Callable[..., Any]
) -> None:
    """Nor does a name that somebody on the machine gave mean another image, when the registry has one by it."""
    options = {key: value for key, value in docker_site.options().items() if key not in ("engine", "pull")}
    with registry(registry_program, tmp_path) as host:
        name = f"{host}/toy:1"
        docker_site.docker("tag", docker_site.images.toy, name)
        docker_site.docker("push", "-q", name)
        docker_site.docker("rmi", name)
        token = house.operator.invite(Invite(name="edge", options=options)).token
        joined = join(house.options(token, engine=ENGINE, registries=(host,)))
        assert joined.stands.state == "ready", joined.stands.reason
        house.operator.put_service("toy", manifest(entrypoint=None, image=name))
        with program(house.store()) as linked:
            until(lambda: linked and house.state() == "ready")
            for _ in range(2):  # pulled, and there already
                made = house.operator.create_instance(InstanceCreate(robot="walker", service="toy", lease_s=1000))
                house.operator.wait_running(made.id)
                house.operator.delete_instance(made.id)
                until(lambda: not house.operator.get_site("edge").instances)
            assert docker_site.docker("images", "-q", name) == "", "it has no name there"
            (digest,) = house.store().names()[name]
            docker_site.docker("tag", docker_site.images.name("base"), name)
            way = f"unix://{house.core.settings.state_dir}/sites/edge/engine.sock"
            client = Engine(way, version="1.41", timeout=30)
            try:
                own = docker_site.docker("inspect", "-f", "{{.Id}}", name)
                assert client.inspect_image(name)["Id"] == own
                with pytest.raises(APIError, match="is this machine's own"):
                    client.pull(name)
                assert client.inspect_image(f"{host}/toy@{digest}")["Id"] != own
                with pytest.raises(APIError, match="manifest unknown"):
                    client.pull(f"{host}/toy:2")
            finally:
                client.close()
                docker_site.docker("rmi", name, f"{host}/toy@{digest}")
            assert house.operator.delete_site("edge")


def refuses_to_be_had(house: NodeScene, docker_site: DockerSite, ours: str) -> None:
    """Whoever has the orchestrator gets neither the node's files, nor what else runs there, nor a shell in it."""
    way = f"unix://{house.core.settings.state_dir}/sites/edge/engine.sock"
    image = docker_site.images.name("base")
    # Of another owner: this orchestrator removes helpers of its own that it does not know.
    good = holder(DockerOptions(network=docker_site.network), f"{docker_site.owner}-else", image)
    stranger = docker_site.docker("create", "--entrypoint", "/bin/sleep", image, "60")
    client = Engine(way, version="1.41", timeout=30)
    try:
        client.remove_container(client.create_container_from_config(good)["Id"])
        for key, value in (("Binds", ["/:/host"]), ("Privileged", True), ("NetworkMode", "host"), ("PidMode", "host")):
            with pytest.raises(
                APIError, match=f"this machine's node refuses it: .*{'host' if key == 'NetworkMode' else key}"
            ):
                client.create_container_from_config({**good, "HostConfig": {**good["HostConfig"], key: value}})
        with pytest.raises(APIError, match="is nothing that a site needs"):
            client.exec_create(ours, "/bin/true")
        with pytest.raises(APIError, match="is not of an orchestrator"):
            client.remove_container(stranger, force=True)
        with pytest.raises(APIError, match="something else of this machine"):
            client.create_volume("skytether-x", driver_opts={"type": "none", "o": "bind", "device": "/"})
        assert docker_site.docker("inspect", "-f", "{{.State.Status}}", stranger) == "created"
        gets_nothing_by_a_way_around(client, good, docker_site, image)
        assert docker_site.docker("inspect", "-f", "{{.State.Status}}", stranger) == "created"
    finally:
        client.close()
        docker_site.docker("rm", "-f", stranger)


def gets_nothing_by_a_way_around(client: Engine, good: dict[str, Any], docker_site: DockerSite, image: str) -> None:
    """All of these were ways to the machine, at an engine of version 20.10."""

    def asked(method: str, path: str, **more: Any) -> tuple[int, str]:
        answer = client.request(method, f"{client.base_url}{path}", timeout=30, **more)
        return answer.status_code, answer.text

    def refused(method: str, path: str, **more: Any) -> bool:
        status, text = asked(method, path, **more)
        return status == HTTPStatus.FORBIDDEN and (method == "HEAD" or "this machine's node refuses it" in text)

    form = {"Content-Type": "application/x-www-form-urlencoded"}
    guards = quote(json.dumps({"label": ["skytether.io/guard"]}))
    assert refused("POST", f"/v1.41/containers/prune?filters={guards}", data='"a&filters={}&"', headers=form)
    source = quote("http://127.0.0.1:9/")
    assert refused(
        "POST", "/v1.41/images/create?fromImage=a&tag=1", data=f'"a&fromImage=&fromSrc={source}&"', headers=form
    )
    name, _, tag = image.rpartition(":")
    assert refused("POST", f"/v1.41/images/create?fromImage={name}&tag={tag}")  # it was made on this machine
    assert refused(
        "POST", "/v1.41/images/create?fromImage=127.0.0.1:8600/x&tag=1"
    )  # nor is a program on loopback asked
    assert refused("GET", "/v1.41/containers/json?all=1")
    assert refused("GET", "/v1.41/networks/bridge")
    made = client.create_container_from_config(good)["Id"]
    try:
        assert refused("POST", f"/v1.23/containers/{made}/start", json={"Binds": ["/:/host"], "Privileged": True})
        assert docker_site.docker("inspect", "-f", "{{.HostConfig.Binds}}", made) == "[]"
    finally:
        client.remove_container(made)
    # An engine mounts the inner one from the outside: where the outer one's links point by then.
    tar = io.BytesIO()
    with tarfile.open(fileobj=tar, mode="w") as files:
        link = tarfile.TarInfo("alias")
        link.type, link.linkname = tarfile.SYMTYPE, "outer"
        files.addfile(link)
    imported = subprocess.run(["docker", "import", "-"], input=tar.getvalue(), capture_output=True, check=True)
    linked = imported.stdout.decode().strip()
    try:
        for of, inner, good_way in ((image, "/outer/a/b", False), (linked, "/alias/a/b", False), (linked, "/b", True)):
            options = {"Labels": good["Labels"]}
            mounts = [{"Type": "volume", "Target": path, "VolumeOptions": options} for path in ("/outer", inner)]
            body = {**good, "Image": of, "HostConfig": {**good["HostConfig"], "Mounts": mounts}}
            made = client.create_container_from_config(body)["Id"]
            try:
                status, _ = asked("HEAD", f"/v1.41/containers/{made}/archive?path={quote(READY)}")
                assert status == HTTPStatus.NOT_FOUND, inner
                assert refused("POST", f"/v1.41/containers/{made}/start") is not good_way, inner
            finally:
                client.remove_container(made, v=True, force=True)
    finally:
        docker_site.docker("rmi", "-f", linked)
