"""Builds the container images: ``make images``, or ``python images/build.py [NAME ...]``.

Wheels are made and fetched here, outside, with the hashes of ``requirements.lock``; a build copies them in and asks no
package index. Debian's own packages come from its archive, within the build.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import re
import shutil
import subprocess
import sys
import tarfile
import time
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from urllib.parse import quote

import docker
import pip
from docker.errors import DockerException
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
IMAGES = ROOT / "images"
WORK = ROOT / "build" / "images"
TAG = "1"
SOURCE = "source"
PYTHON = "3.11"
"""Debian 12's."""
EXTRAS: dict[str, tuple[str, ...]] = {
    "base": (),
    "recorder": ("recorder",),
    "navigation": ("navigation",),
    "follow-in-front": ("follow-in-front",),
    "orchestrator": ("orchestrator", "docker", "kubernetes", "postgres", "recorder"),
}
"""Images with wheels of their own, and the extras that these are; all but the base's, which they are built on."""
_NUMERICAL = ("numpy", "numpy.libs")
_FETCH_TIMEOUT = 600


class BuildError(Exception):
    """One sentence that says what to do."""


@dataclass(frozen=True)
class Built:
    """One image.

    Attributes:
        image: Name and tag.
        seconds: The build took, its cache as it was.
        size_mb: In millions of bytes, all layers.
        numerical_mb: Of these, its numerical libraries.
    """

    image: str
    seconds: float
    size_mb: float
    numerical_mb: float


def locked(lock: str, environment: dict[str, str]) -> dict[str, tuple[str, frozenset[str]]]:
    """By package of a lock file, as far as it holds in an environment: its pin with hashes, and what needs it."""
    found = {}
    for block in re.split(r"\n(?=[a-z0-9])", lock):
        if not re.match(r"[A-Za-z0-9_.-]+==", block):
            continue
        pinned, _, via = block.partition("\n    # via")
        text, _, hashes = pinned.partition("\\\n")
        requirement = Requirement(text.strip())
        if requirement.marker is None or requirement.marker.evaluate(environment):
            wanted_by = frozenset(
                canonicalize_name(name) for name in re.findall(r"^\s*#?\s+([\w.-]+)", via, re.MULTILINE)
            )
            row = f"{requirement.name}{requirement.specifier} \\\n{hashes}"
            found[canonicalize_name(requirement.name)] = (row, wanted_by)
    return found


def closure(roots: Iterable[str], packages: dict[str, tuple[str, frozenset[str]]]) -> set[str]:
    """The packages named, and all that they need."""
    wanted = set(roots)
    while True:
        more = {name for name, (_, wanted_by) in packages.items() if wanted_by & wanted} - wanted
        if not more:
            return wanted
        wanted |= more


def requirements(extras: Iterable[str], machine: str) -> dict[str, str]:
    """By package, the pinned requirement of Skytether with these extras for Debian's Python on such a machine."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    names = project["dependencies"] + [row for extra in extras for row in project["optional-dependencies"][extra]]
    environment = {
        "python_version": PYTHON,
        "python_full_version": f"{PYTHON}.2",
        "implementation_name": "cpython",
        "platform_python_implementation": "CPython",
        "platform_machine": machine,
        "sys_platform": "linux",
        "platform_system": "Linux",
        "os_name": "posix",
    }
    packages = locked((ROOT / "requirements.lock").read_text(), environment)
    wanted = closure((canonicalize_name(Requirement(row).name) for row in names), packages)
    return {name: packages[name][0] for name in wanted}


def fetch(group: str, machine: str) -> None:
    """Have the wheels of an image, and the list that they are installed from."""
    rows = requirements(EXTRAS[group], machine)
    if group != "base":
        rows = {name: row for name, row in rows.items() if name not in requirements((), machine)}
    text = "\n".join(rows[name] for name in sorted(rows)) + "\n"
    listed, folder = WORK / f"{group}.txt", WORK / "wheels" / group
    note = folder / ".complete"
    digest = hashlib.sha256(f"{machine}\n{text}".encode()).hexdigest()
    if note.exists() and note.read_text() == digest:
        return
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    listed.write_text(text)
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
    command += ["--require-hashes", "--only-binary", ":all:", "--implementation", "cp", "--python-version", PYTHON]
    for platform in _platforms(machine):
        command += ["--platform", platform]
    _run([*command, "--dest", str(folder), "-r", str(listed)], "the wheels could not be fetched")
    note.write_text(digest)


def _platforms(machine: str) -> Iterator[str]:
    """The platforms whose wheels run on Debian 12 (glibc 2.36)."""
    yield from (f"manylinux_2_{minor}_{machine}" for minor in range(36, 4, -1))
    yield from (f"{old}_{machine}" for old in ("manylinux2014", "manylinux2010", "manylinux1"))


def make_wheel() -> None:
    """Skytether's own wheel; the same bytes from the same files."""
    folder = WORK / "wheels" / "project"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--disable-pip-version-check", "--no-deps"]
    _run([*command, "--no-build-isolation", "--wheel-dir", str(folder), str(ROOT)], "Skytether's wheel was not built")


def _run(command: list[str], trouble: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, timeout=_FETCH_TIMEOUT, check=False)
    if done.returncode:
        lines = (done.stderr or done.stdout).strip().splitlines()
        raise BuildError(f"{trouble}: {lines[-1] if lines else done.returncode}")


def order(names: Iterable[str]) -> list[str]:
    """What is asked for, and what that is built on, the base first."""
    wanted = list(dict.fromkeys(names)) or sorted(known())
    unknown = [name for name in wanted if name not in known()]
    if unknown:
        raise BuildError(f"there is no image '{unknown[0]}'; there are {', '.join(sorted(known()))}")
    if any(needs(name, "BASE") for name in wanted):
        wanted.insert(0, "base")
    return sorted(dict.fromkeys(wanted), key=lambda name: name != "base")


def known() -> set[str]:
    """The images that can be built."""
    return {path.parent.name for path in IMAGES.glob("*/Dockerfile")}


def context(name: str) -> bytes:
    """What an image is built from, as a tar file: its folder, its wheels. Times are left out, for the cache."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as tar:
        tar.add(IMAGES / name, ".", filter=_plain)
        if name in EXTRAS:
            tar.add(WORK / f"{name}.txt", f"{name}.txt", filter=_plain)
            tar.add(WORK / "wheels" / name, f"wheels/{name}", filter=_plain)
            tar.add(Path(pip.__file__).parent, "pip/pip", filter=_plain)
        if name == "base":
            tar.add(WORK / "wheels" / "project", "wheels/project", filter=_plain)
    return buffer.getvalue()


def _plain(entry: tarfile.TarInfo) -> tarfile.TarInfo | None:
    entry.mtime = entry.uid = entry.gid = 0
    entry.uname = entry.gname = ""
    entry.mode = 0o755 if entry.isdir() else 0o644
    return None if entry.name.endswith(("/.complete", "/__pycache__")) else entry


def labels(name: str) -> dict[str, str]:
    """The labels that the Open Container Initiative names."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    git = shutil.which("git") or "git"
    asked = [git, "-C", str(ROOT), "log", "-1", "--format=%H %cI"]
    revision, _, created = (
        subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip().partition(" ")
    )
    said = {
        "title": f"skytether {name}",
        "description": project["description"],
        "version": project["version"],
        "licenses": project["license"],
        "vendor": project["authors"][0]["name"],
        "revision": revision,
        "created": created,
    }
    return {f"org.opencontainers.image.{key}": value for key, value in said.items() if value}


def needs(name: str, what: str) -> bool:
    """Whether an image is built on BASE or DEBIAN."""
    return f"ARG {what}" in (IMAGES / name / "Dockerfile").read_text()


def source_tag(name: str, debian_id: str) -> str:
    """A tag that says what an image is made from: the same for the same files, wheels and image of Debian."""
    parts = [context(name), debian_id.encode() if needs(name, "DEBIAN") else b""]
    parts += [source_tag("base", debian_id).encode()] if needs(name, "BASE") else []
    return "s-" + hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).hexdigest()[:16]


def tags(client: docker.DockerClient, names: Iterable[str], tag: str, debian: str) -> dict[str, str]:
    """By image, its tag."""
    if tag != SOURCE:
        return dict.fromkeys(names, tag)
    debian_id = str(client.api.inspect_image(debian)["Id"])
    return {name: source_tag(name, debian_id) for name in names}


def build(client: docker.DockerClient, name: str, prefix: str, tagged: dict[str, str], debian: str) -> Built:
    """Build one image; what it is built on is there."""
    image = f"{prefix}{name}:{tagged[name]}"
    begun = time.monotonic()
    arguments = {"DEBIAN": debian, "BASE": f"{prefix}base:{tagged.get('base', '')}"}
    used = {key: value for key, value in arguments.items() if needs(name, key)}
    lines: list[str] = []
    for line in client.api.build(
        fileobj=io.BytesIO(context(name)),
        custom_context=True,
        tag=image,
        buildargs=used,
        labels=labels(name),
        rm=True,
        forcerm=True,
        decode=True,
    ):
        lines += [line["stream"].strip()] if line.get("stream", "").strip() else []
        if "error" in line:
            raise BuildError(f"{image} was not built: {line['error']}; before that: {' | '.join(lines[-5:])}")
    seconds = time.monotonic() - begun
    size = client.api.inspect_image(image)["Size"]
    return Built(image, round(seconds, 1), round(size / 1e6, 1), round(_numerical(client, image) / 1e6, 1))


def _numerical(client: docker.DockerClient, image: str) -> int:
    """Bytes of an image's numerical libraries."""
    folders = " ".join(f"/app/lib/python{PYTHON}/site-packages/{name}" for name in _NUMERICAL)
    script = f"for f in {folders}; do [ ! -d $f ] || du -sb $f; done"
    said = client.containers.run(image, ["-c", script], entrypoint="/bin/sh", remove=True, network_disabled=True)
    return sum(int(line.split()[0]) for line in said.decode().splitlines())


_LISTED = """
dpkg-query -W -f 'deb\\t${Package}\\t${Version}\\t${Architecture}\\n'
[ ! -x /app/bin/python ] || /app/bin/python -c '
from importlib.metadata import distributions
for one in distributions(): print("pypi", one.name, one.version, sep="\\t")'
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


def write_bill(client: docker.DockerClient, image: str, folder: Path) -> None:
    """List an image's packages, by its own package managers, into a file beside those of the other images."""
    said = client.containers.run(image, ["-c", _LISTED], entrypoint="/bin/sh", remove=True, network_disabled=True)
    folder.mkdir(parents=True, exist_ok=True)
    document = bill(image, client.api.inspect_image(image)["Id"], said.decode())
    name = re.sub(r"[^A-Za-z0-9.-]", "_", image)
    (folder / f"{name}.cdx.json").write_text(json.dumps(document, indent=1) + "\n")


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("name", nargs="*", help="default: all of them")
    parser.add_argument("--prefix", default="skytether/", help="before each name, such as REGISTRY/skytether/")
    parser.add_argument("--tag", default=TAG, help=f"{SOURCE}: one for each that says what it is made from")
    parser.add_argument("--debian", default="debian:bookworm-slim", help="what the base is built from")
    parser.add_argument("--sbom", type=Path, help="write a list of each image's packages (CycloneDX) into this folder")
    parser.add_argument("--json", action="store_true", help="print rows `image, seconds, size_mb, numerical_mb`")
    asked = parser.parse_args()
    rows = []
    try:
        names = order(asked.name)
        client = docker.from_env(timeout=_FETCH_TIMEOUT)
        machine = str(client.info()["Architecture"])
        for group in EXTRAS:
            if group in names:
                fetch(group, machine)
        if "base" in names:
            make_wheel()
        tagged = tags(client, names, asked.tag, asked.debian)
        for name in names:
            rows.append(build(client, name, asked.prefix, tagged, asked.debian))
            if asked.sbom:
                write_bill(client, rows[-1].image, asked.sbom)
            if not asked.json:
                print(_line(rows[-1]), flush=True)
    except (BuildError, subprocess.TimeoutExpired, DockerException) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    if asked.json:
        print(json.dumps([asdict(row) for row in rows], indent=2))
    return 0


def _line(row: Built) -> str:
    without = f", {row.size_mb - row.numerical_mb:.0f} MB without numerical libraries" if row.numerical_mb else ""
    return f"{row.image:40} {row.seconds:6.1f} s {row.size_mb:6.0f} MB{without}"


if __name__ == "__main__":
    sys.exit(main())
