"""A machine that joined, with a real engine: containers are started by way of it, and outlive a pulled cable."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from docker_site import DockerSite
from node_scene import NodeScene, program, until

from skytether.api.client import Client
from skytether.api.rest import InstanceCreate, Invite, State
from skytether.node.join import join
from skytether.orchestrator.app import create_app
from skytether.orchestrator.core import Orchestrator
from skytether.orchestrator.settings import Nodes, Settings, Timing

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
