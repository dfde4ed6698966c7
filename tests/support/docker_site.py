"""The images and sites of the tests with a real Docker engine."""

from __future__ import annotations

import json
import os
import secrets
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from one_run import begun_once

from skytether.orchestrator.runtimes.docker import DockerOptions, DockerRuntime
from skytether.orchestrator.runtimes.docker.options import LOCAL_SOCKET

_BUILD = Path(__file__).parents[2] / "images" / "build.py"


def build(prefix: str, *names: str) -> list[dict[str, Any]]:
    """Build images from this very code; what ``--json`` tells of them."""
    command = [sys.executable, str(_BUILD), "--prefix", prefix, "--json", *names]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    rows: list[dict[str, Any]] = json.loads(done.stdout)
    return rows


COMMON = ("base", "guard", "virtual-trail")
"""The images that all tests with an engine have, beside the toy."""


@dataclass(frozen=True)
class Images:
    """The images of one run of the tests, removed at its end, unless the next run is to have them."""

    prefix: str
    rows: list[dict[str, Any]]
    """What ``images/build.py --json`` told of them."""
    folder: Path
    """Which all processes of the run have."""
    kept: bool = False

    @property
    def toy(self) -> str:
        """Runs ``skytether.testing.toy_service``."""
        return f"{self.prefix}toy:1"

    def name(self, image: str) -> str:
        return f"{self.prefix}{image}:1"

    def containers(self, image: str, label: str = "") -> list[str]:
        """Of an image, by their ids, or what a label says where they have it; pods of a cluster here are not ours."""
        shown = f'{{{{.Label "{label}"}}}}' if label else "{{.ID}}"
        pods = '{{if not (.Label "io.kubernetes.pod.name")}}' + shown + "{{end}}"
        command = ["docker", "ps", "-a", "--filter", f"ancestor={self.name(image)}", "--format", pods]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()

    @contextmanager
    def another(self, image: str) -> Iterator[str]:
        """The name of one that few tests need, as long as it is there; what all tests have stays."""
        if self.name(image) in [row["image"] for row in self.rows]:
            yield self.name(image)
            return

        def begin() -> str:
            build(self.prefix, image)
            return image

        with begun_once(self.folder, image, begin, lambda: self.remove(image)):
            yield self.name(image)

    def build_all(self) -> None:
        """What all tests have; of that nothing is left if it fails."""
        try:
            self.rows.extend(build(self.prefix, *COMMON))
            with TemporaryDirectory() as folder:
                (Path(folder) / "Dockerfile").write_text(TOY)
                command = ["docker", "build", "-q", "-t", self.toy, "--build-arg", f"BASE={self.name('base')}", folder]
                environment = {**os.environ, "DOCKER_BUILDKIT": "0"}
                subprocess.run(command, check=True, capture_output=True, env=environment)
        except BaseException:
            self.remove_all()
            raise

    @contextmanager
    def apart(self, image: str) -> Iterator[Images]:
        """Guard and one image under names of their own: a container of it is of who has these, whoever else is here."""
        own = Images(f"{self.prefix}{secrets.token_hex(4)}/", [], self.folder)
        recipe = f"FROM {self.name(image)}\nLABEL apart={own.prefix}\n"
        command = ["docker", "build", "-q", "-t", own.name(image), "-"]
        environment = {**os.environ, "DOCKER_BUILDKIT": "0"}
        try:
            subprocess.run(command, input=recipe, text=True, check=True, capture_output=True, env=environment)
            subprocess.run(["docker", "tag", self.name("guard"), own.name("guard")], check=True)
            yield own
        finally:
            own.remove(image, "guard")

    def remove(self, *images: str) -> None:
        """Remove them from the engine, with the layers that are nobody else's."""
        if not self.kept:
            subprocess.run(["docker", "image", "rm", "-f", *map(self.name, images)], capture_output=True)

    def remove_all(self) -> None:
        """Of what all tests have, and what is left of making it."""
        if not self.kept:
            self.remove("toy", *reversed(COMMON))
            prune = ["docker", "image", "prune", "-f", "--filter", "label=skytether.io/stage"]
            subprocess.run(prune, capture_output=True)


TOY = """\
ARG BASE
FROM ${BASE}
ENTRYPOINT ["/app/bin/python", "-P", "-m", "skytether.testing.toy_service"]
"""


class DockerSite:
    """Docker sites of one owner, with nothing left at the end; they have a network of their own unless one is named."""

    def __init__(self, images: Images, engine: str = f"unix://{LOCAL_SOCKET}", network: str = "") -> None:
        self.images = images
        self.engine = engine
        self.network = network or f"skytether-test-{secrets.token_hex(4)}"
        self.owner = f"test-{secrets.token_hex(4)}"

    def options(self, **changes: object) -> dict[str, object]:
        """The site's options, as over REST."""
        guard = self.images.name("guard")
        return {
            "engine": self.engine,
            "network": self.network,
            "guard_image": guard,
            "owner": self.owner,
            "pull": "never",
        } | changes

    def open(self, folder: Path, **changes: object) -> DockerRuntime:
        return DockerRuntime("edge", folder, DockerOptions.model_validate(self.options(**changes)))

    def docker(self, *arguments: str) -> str:
        """Ask the engine; what it says."""
        done = subprocess.run(["docker", "-H", self.engine, *arguments], capture_output=True, text=True)
        return done.stdout.strip()

    def containers(self) -> list[str]:
        """Ids of those of this site's instances, ended ones too."""
        return self.labelled("skytether.io/instance")

    def helpers(self) -> list[str]:
        """Ids of the others: guards, and what holds a network."""
        return self.labelled("skytether.io/helper")

    def labelled(self, label: str, *more: str) -> list[str]:
        """Ids of this site's containers with a label as well; ``more`` filters."""
        labels = f"label=skytether.io/owner={self.owner}", f"label={label}"
        filters = [f"--filter={one}" for one in (*labels, *more)]
        return self.docker("ps", "-aq", "--no-trunc", *filters).split()

    def volumes(self) -> list[str]:
        """Names of the volumes that hold what the services wrote."""
        return self.docker("volume", "ls", "-q", "--filter", f"name=skytether-{self.owner}-data-").split()

    def volumes_with(self, *labels: str) -> list[str]:
        """Names of this site's volumes with these labels: ``skytether.io/instance``, or ``skytether.io/epoch``."""
        filters = [f"--filter=label={label}" for label in (f"skytether.io/owner={self.owner}", *labels)]
        return self.docker("volume", "ls", "-q", *filters).split()

    def clean(self) -> None:
        """Remove containers and data, that of sites too whose owner's name is longer by something."""
        longer = self.docker("volume", "ls", "-q", "--filter", f"name=skytether-{self.owner}-").split()
        for kind, names in (
            ("container", self.containers() + self.helpers()),
            ("volume", sorted({*self.volumes_with(), *longer})),
        ):
            if names:
                self.docker(kind, "rm", *(["-f", "-v"] if kind == "container" else ["-f"]), *names)

    def close(self) -> None:
        """Remove the network too."""
        self.clean()
        self.docker("network", "rm", self.network)

    def nft(self, network: str, script: str) -> str:
        """What nftables says to a script in a network, ``host`` or ``container:ID``."""
        command = ["run", "--rm", "--network", network, "--cap-add", "NET_ADMIN", self.images.name("guard")]
        return self.docker(*command, script)
