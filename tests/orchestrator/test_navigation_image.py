"""The image of navigation: a robot is driven by a container of it, and nothing is compiled in there."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from docker_site import DockerSite, Images

from skytether.lab.nine_goals import SCENARIOS, Trial, TrialSettings

pytestmark = [pytest.mark.docker, pytest.mark.slow]

COMPILED = "cd {} && find . -type f | sort | xargs sha256sum"


@pytest.fixture(scope="module")
def navigation_image(docker_images: Images) -> Iterator[str]:
    build = Path(__file__).parents[2] / "images" / "build.py"
    image = docker_images.name("navigation")
    command = [sys.executable, str(build), "--prefix", docker_images.prefix, "--json", "navigation"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    yield image
    subprocess.run(["docker", "image", "rm", "-f", image], capture_output=True)


def test_a_container_of_it_drives_a_robot_and_compiles_nothing(docker_site: DockerSite, navigation_image: str) -> None:
    (made,) = json.loads(docker_site.docker("image", "inspect", navigation_image))
    assert made["Size"] < 900e6
    assert made["Config"]["User"] == "65532:65532"
    with Trial(
        TrialSettings(SCENARIOS["edge"], docker=docker_site.options(), image=navigation_image, goals=1)
    ) as trial:
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
