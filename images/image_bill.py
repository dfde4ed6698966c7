"""What an image is made of, for what looks for advisories."""

from __future__ import annotations

import json
import re
from pathlib import Path
from urllib.parse import quote

import docker
from packaging.utils import canonicalize_name

_LISTED = """
dpkg-query -W -f 'deb\\t${Package}\\t${Version}\\t${Architecture}\\n'
for python in /app/bin/python /opt/ros2/bin/python; do [ ! -x $python ] || $python -c '
from importlib.metadata import distributions
for one in distributions(): print("pypi", one.name, one.version, sep="\\t")'; done
"""
"""Says a row of an image's every package: its kind, name, version, architecture."""


def bill(image: str, image_id: str, listed: str) -> dict[str, object]:
    """What an image is made of, as CycloneDX 1.5 wants it (https://cyclonedx.org): the same text for the same image."""
    components = []
    for kind, name, version, *architecture in sorted({tuple(line.split("\t")) for line in listed.splitlines() if line}):
        where = "deb/debian" if kind == "deb" else kind
        known = name if kind == "deb" else canonicalize_name(name)
        purl = f"pkg:{where}/{quote(known)}@{quote(version, safe='~')}"
        purl += f"?arch={architecture[0]}" if architecture else ""
        components.append({"type": "library", "name": name, "version": version, "purl": purl, "bom-ref": purl})
    about = {"type": "container", "name": image, "version": image_id}
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": about},
        "components": components,
    }


def packages(client: docker.DockerClient, image: str) -> str:
    """A row of each package of an image, by its own package managers."""
    said = client.containers.run(image, ["-c", _LISTED], entrypoint="/bin/sh", remove=True, network_disabled=True)
    return str(said.decode())


def write_bill(client: docker.DockerClient, image: str, folder: Path) -> None:
    """List an image's packages into a file beside those of the other images."""
    folder.mkdir(parents=True, exist_ok=True)
    document = bill(image, client.api.inspect_image(image)["Id"], packages(client, image))
    name = re.sub(r"[^A-Za-z0-9.-]", "_", image)
    (folder / f"{name}.cdx.json").write_text(json.dumps(document, indent=1) + "\n")
