"""The image of navigation: containers of it drive robots, cold and kept warm, and nothing is compiled in there."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator

import pytest
from docker_site import DockerSite, Images
from shared_halls import share

from skytether.api.client import Client
from skytether.api.rest import Instance, InstanceCreate, RobotCreate, SiteCreate, State
from skytether.lab.bench.start_robots import ROBOTS, Watch
from skytether.lab.embedded import EmbeddedOrchestrator
from skytether.lab.nine_goals import SCENARIOS, NineGoalsSettings, NineGoalsTrial
from skytether.robot.agent.config import AgentConfig

pytestmark = [pytest.mark.docker, pytest.mark.slow]

PATIENCE_S = 60.0
COMPILED = "cd {} && find . -type f | sort | xargs sha256sum"


@pytest.fixture(scope="module")
def navigation_image(docker_images: Images) -> Iterator[str]:
    with docker_images.another("navigation") as image:
        yield image


def test_a_container_of_it_drives_a_robot_and_compiles_nothing(docker_site: DockerSite, navigation_image: str) -> None:
    (made,) = json.loads(docker_site.docker("image", "inspect", navigation_image))
    assert made["Size"] < 900e6
    assert made["Config"]["User"] == "65532:65532"
    options = docker_site.options()
    del options["network"]  # the trial makes its own
    with NineGoalsTrial(NineGoalsSettings(SCENARIOS["edge"], docker=options, image=navigation_image, goals=1)) as trial:
        result = trial.drive()
        (container,) = docker_site.containers()
        brought, kept = (
            docker_site.docker("exec", container, "/bin/sh", "-c", COMPILED.format(folder))
            for folder in ("/app/numba", "/tmp/numba")
        )
    assert result.completed, result
    assert result.goals == 1
    assert brought
    assert kept == brought
    left = docker_site.containers(), docker_site.helpers(), docker_site.volumes_with()
    assert left == ([], [], [])
    assert docker_site.docker("network", "ls", "-q", "--filter", f"name=skytether-{docker_site.owner}") == ""


def use_docker(operator: Client, site: DockerSite, image: str) -> None:
    """Make the engine the only site, and have it run this image."""
    manifest = operator.get_service("navigation")
    spec = manifest.spec.model_copy(update={"image": image})
    operator.put_service("navigation", manifest.model_copy(update={"spec": spec}))
    operator.create_site(SiteCreate(name="docker", tier="edge", runtime="docker", options=site.options()))
    operator.delete_site("local")


def keep_a_standby(operator: Client) -> None:
    manifest = operator.get_service("navigation")
    needs = manifest.spec.needs.model_copy(update={"standby": 1})
    spec = manifest.spec.model_copy(update={"needs": needs})
    operator.put_service("navigation", manifest.model_copy(update={"spec": spec}))


def until(what: Callable[[], bool], told: Callable[[], object]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < end, told()
        time.sleep(0.05)


def test_a_standby_moves_the_robot_and_is_not_started_for_it(docker_site: DockerSite, navigation_image: str) -> None:
    asking, watch = ROBOTS["navigation"](), Watch()
    with EmbeddedOrchestrator() as orchestrator, Client(orchestrator.url, orchestrator.operator_token) as operator:
        use_docker(operator, docker_site, navigation_image)
        token = operator.create_robot(RobotCreate(name="pioneer", services=("navigation",))).token
        # A standby is made for what was asked for last.
        asked = InstanceCreate(robot="pioneer", service="navigation", params=dict(asking.params))
        operator.delete_instance(operator.create_instance(asked).id)
        keep_a_standby(operator)

        def standbys() -> list[Instance]:
            nobodys = (one for one in operator.instances() if not one.robot and not one.state.final)
            return [one for one in nobodys if one.params == asked.params]

        until(lambda: [one.state for one in standbys()] == [State.RUNNING], standbys)
        (standby,) = standbys()
        its_label = f"skytether.io/instance={standby.id}"
        (container,) = docker_site.labelled(its_label)
        url, service = orchestrator.url, "navigation"
        config = AgentConfig("pioneer", url, service, token, params=asked.params, bind=("127.0.0.1", 0))
        with asking.agent(config, watch) as agent:
            until(lambda: watch.moved_at is not None, agent.status)
            its_instance = agent.status().instance
            assert its_instance is not None
            assert its_instance.id == standby.id
            assert docker_site.labelled(its_label) == [container]


def test_two_containers_share_by_their_robots_and_one_orchestrator(
    docker_site: DockerSite, navigation_image: str
) -> None:
    containers: list[str] = []
    share(
        lambda operator: use_docker(operator, docker_site, navigation_image),
        lambda: containers.extend(docker_site.containers()),
    )
    assert len(containers) == 2
