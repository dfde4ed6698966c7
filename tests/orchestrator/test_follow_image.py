"""The image of following in front: a container of it sees a person and drives a robot ahead of them."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest
from docker_site import DockerSite, Images

from skytether.lab.follow_in_front import SCENARIOS, FollowSettings, FollowTrial

pytestmark = [pytest.mark.docker, pytest.mark.slow]

LIBRARIES_OF_X = "find / -xdev -name 'libX11*' -o -xdev -name 'libGL*' -o -xdev -name 'libEGL*'"


@pytest.fixture(scope="module")
def follow_image(docker_images: Images) -> Iterator[str]:
    with docker_images.another("follow-in-front") as image:
        yield image


def test_a_container_of_it_drives_a_robot_ahead_of_a_person(
    docker_site: DockerSite,
    follow_image: str,
    gl: None,
) -> None:
    (made,) = json.loads(docker_site.docker("image", "inspect", follow_image))
    assert made["Size"] < 600e6
    assert made["Config"]["User"] == "65532:65532"
    options = docker_site.options()
    del options["network"]  # the trial makes its own
    settings = FollowSettings(SCENARIOS["edge"], docker=options, image=follow_image, share=0.1)
    with FollowTrial(settings) as trial:
        result = trial.drive()
        (container,) = docker_site.containers()
        assert docker_site.docker("exec", container, "/bin/sh", "-c", LIBRARIES_OF_X) == ""
    assert result.completed, result
    assert result.kte_m < 0.17
