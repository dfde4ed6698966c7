"""The images, as they were built for the tests from this very code."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest
from docker import from_env
from docker_site import Images
from image_builder import build_script

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


def test_what_is_in_each_image_can_be_listed(docker_images: Images, tmp_path: Path) -> None:
    """By its own package managers, without a network; of those that a service's is built on, all."""
    client = from_env()
    try:
        listed = {}
        for name in ("base", "virtual-trail", "guard"):
            build_script().write_bill(client, docker_images.name(name), tmp_path)
        for path in tmp_path.iterdir():
            made = json.loads(path.read_text())
            listed[made["metadata"]["component"]["name"]] = {
                row["purl"].partition("@")[0] for row in made["components"]
            }
    finally:
        client.close()
    base, trail, guard = (listed[docker_images.name(name)] for name in ("base", "virtual-trail", "guard"))
    assert {"pkg:deb/debian/python3", "pkg:pypi/skytether", "pkg:pypi/cryptography"} <= base <= trail
    assert "pkg:deb/debian/nftables" in guard
    assert not any(one.startswith("pkg:pypi") for one in guard)


@pytest.mark.parametrize("name", ["base", "virtual-trail", "guard"])
def test_no_program_in_an_image_gives_its_caller_anothers_rights(docker_images: Images, name: str) -> None:
    arguments = ["--rm", "--network", "none", "--user", "0", "--entrypoint", "/usr/bin/find"]
    assert docker("run", *arguments, docker_images.name(name), "/", "-xdev", "-type", "f", "-perm", "/6000") == ""


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
