"""The images, as they were built for the tests from this very code."""

from __future__ import annotations

import json
import subprocess

import pytest
from docker_site import Images

pytestmark = [pytest.mark.docker, pytest.mark.slow]


def docker(*arguments: str) -> str:
    return subprocess.run(["docker", *arguments], check=True, capture_output=True, text=True).stdout.strip()


def test_what_an_image_says_of_itself(docker_images: Images) -> None:
    (made,) = json.loads(docker("image", "inspect", docker_images.name("virtual-trail")))
    config = made["Config"]
    assert config["User"] == "65532:65532"
    assert config["Healthcheck"]["Test"][0] == "CMD"
    assert config["Entrypoint"] == ["/app/bin/python", "-P", "-m", "skytether_services.virtual_trail"]
    said = {key.removeprefix("org.opencontainers.image."): value for key, value in config["Labels"].items()}
    assert said["title"] == "skytether virtual-trail"
    assert {"description", "version", "licenses", "vendor", "revision", "created"} <= said.keys()
    (row,) = [row for row in docker_images.rows if row["image"] == docker_images.name("virtual-trail")]
    assert row["seconds"] > 0
    assert 0 < row["size_mb"] - row["numerical_mb"] < 250


def test_there_is_nothing_in_it_that_a_service_does_not_need(docker_images: Images) -> None:
    look = """
        cd /app/lib/python3.*/site-packages
        find . -name pip -o -name setuptools -o -name tests -o -name '*.pyi'
        find . ! -perm -o=r -o -perm /o=w ! -type l
        find . -mindepth 1 -newermt 1970-01-02   # times that change make other bytes of the same files
        find . -name '*.py' -path './skytether/*' | while read f; do
            [ -e "$(dirname $f)/__pycache__/$(basename $f .py).cpython-311.pyc" ] || echo "$f is not compiled"
        done
        command -v gcc curl wget
    """
    image = docker_images.name("virtual-trail")
    arguments = ["--rm", "--read-only", "--network", "none", "--cap-drop", "ALL", "--entrypoint", "/bin/sh"]
    assert docker("run", *arguments, image, "-c", f"{look} true") == ""
