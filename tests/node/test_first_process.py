"""At a real engine no link of an image leads to another first process than the engine's own."""

from __future__ import annotations

import io
import secrets
import tarfile
from collections.abc import Callable, Iterator
from http import HTTPStatus
from pathlib import Path

import docker
import pytest
from gated_engine import Gated, gated

__all__ = ["gated"]
pytestmark = [pytest.mark.docker, pytest.mark.slow]

Import = Callable[[dict[str, str]], str]


@pytest.fixture
def an_image(docker_engine: str, tmp_path: Path) -> Iterator[Import]:
    """Makes an image that has links, by their paths, and a folder ``own``; returns its name."""
    client, names = docker.from_env(), list[str]()

    def make(links: dict[str, str]) -> str:
        path = tmp_path / f"{len(names)}.tar"
        with tarfile.open(path, "w") as archive:
            for folder in ("own", "usr", "usr/sbin", "proc", "proc/self"):
                row = tarfile.TarInfo(folder)
                row.type, row.mode = tarfile.DIRTYPE, 0o755
                archive.addfile(row)
            for name, target in links.items():
                row = tarfile.TarInfo(name)
                row.type, row.linkname = tarfile.SYMTYPE, target
                archive.addfile(row)
            body = b"sleep"
            row = tarfile.TarInfo("sleep")
            row.size, row.mode = len(body), 0o755
            archive.addfile(row, io.BytesIO(body))
        names.append(f"skytether-links-{secrets.token_hex(4)}:1")
        client.api.import_image(src=str(path), repository=names[-1].partition(":")[0], tag="1")
        return names[-1]

    yield make
    for name in names:
        client.images.remove(name, force=True)
    client.close()


@pytest.mark.parametrize(
    ("links", "refused"),
    [
        ({}, False),
        ({"sbin": "usr/sbin"}, False),
        ({"sbin": "/usr/sbin"}, False),
        ({"sbin": "own/sbin"}, True),
        ({"sbin": "/proc/self/cwd/usr/sbin"}, True),
        ({"sbin": "again", "again": "own/sbin"}, True),
        # In the image these end at /usr/sbin, and in the container they do not.
        ({"sbin": "own/link", "own/link": "/usr/sbin"}, True),
        ({"sbin": "/proc/self/cwd", "proc/self/cwd": "/usr/sbin"}, True),
        ({"usr/sbin/docker-init": "/own/init", "sbin": "usr/sbin"}, True),
    ],
)
def test_the_way_to_the_engines_own_first_process(
    gated: Gated, an_image: Import, links: dict[str, str], *, refused: bool
) -> None:
    gated.network()
    made = gated.create(an_image(links))
    said = gated.ask(f"POST /containers/{made}/start")
    text = said.content.decode()
    if refused:
        assert (said.status, "this machine's node refuses it" in text) == (HTTPStatus.FORBIDDEN, True), text
    else:
        # The engine was asked: what is to run in it is no program.
        assert said.status != HTTPStatus.FORBIDDEN, text
