"""A manifest that the project ships runs unchanged on each kind of site, and drives a robot from there."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from docker_runs import until
from docker_site import DockerSite
from kubernetes_house import OPERATOR, House
from kubernetes_site import KubernetesSite

from skytether.api.rest import SiteCreate, State

pytestmark = [pytest.mark.slow, pytest.mark.docker, pytest.mark.kubernetes]

SHIPPED = "skytether/virtual-trail:1"


def docker(*arguments: str, check: bool = True) -> str:
    return subprocess.run(["docker", *arguments], capture_output=True, text=True, check=check).stdout.strip()


@pytest.fixture
def shipped_image(docker_site: DockerSite) -> Iterator[None]:
    """The image that the manifest names is that of this code; one of before has its name again afterwards."""
    before = docker("image", "inspect", "-f", "{{.Id}}", SHIPPED, check=False)
    docker("tag", docker_site.images.name("virtual-trail"), SHIPPED)
    yield
    docker(*(("tag", before, SHIPPED) if before else ("image", "rm", SHIPPED)))


@pytest.mark.usefixtures("shipped_image")
def test_one_manifest_runs_on_a_machine_on_an_engine_and_on_a_cluster(
    kubernetes_site: KubernetesSite, docker_site: DockerSite, tmp_path: Path
) -> None:
    house = House(tmp_path / "state", kubernetes_site)
    try:
        lab = SiteCreate(name="lab", tier="edge", runtime="process", cost=20)
        edge = SiteCreate(name="edge", tier="edge", runtime="docker", options=docker_site.options(), cost=10)
        ward = SiteCreate(name="ward", tier="edge", runtime="kubernetes", options=kubernetes_site.options())
        house.core.sites.delete("ward")
        for site in (lab, edge, ward):  # each is cheaper than those before
            added = house.core.sites.add(site)
            until(lambda: not added.unreachable)  # noqa: B023
            instance = house.ask("virtual-trail")
            assert house.until(instance, State.RUNNING).site == site.name
            house.drive(instance)
            house.core.instances.delete(OPERATOR, instance)
            house.until(instance, State.STOPPED)
    finally:
        house.core.stop()
