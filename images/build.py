"""Builds the container images: ``make images``, or ``python images/build.py [NAME ...]``; ``--push`` to a registry.

Wheels are made and fetched here, outside, with the hashes of ``requirements.lock``; a build copies them in and asks no
package index. Debian's own packages come from its archive, within the build.
"""

from __future__ import annotations

import argparse
import fcntl
import hashlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import time
import tomllib
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory

import docker
import pip
import yaml
from docker.errors import DockerException
from image_bill import bill, packages, write_bill
from image_push import Pushed, Pusher, values
from image_registry import RegistryError
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
    "orchestrator": ("orchestrator", "docker", "kubernetes", "openstack", "postgres", "recorder"),
}
"""Images with wheels of their own, and the extras that these are; all but the base's, which they are built on."""
ROS2 = "ros2-base"
"""The image with wheels of ROS 2, which have a lock file of their own."""
_ROS2_TESTS = ("ros-test-msgs", "cyclonedds")
"""Of those the ones that are for tests and benches only."""
_ROS2_LACKS = ("empy", "lark-parser", "numpy", "setuptools")
"""What they say they need, and the image does without: the base has it, or only builds use it."""
_ROS2_MACHINE = "x86_64"
"""What PyPI has those wheels for."""
_NUMERICAL = ("numpy", "numpy.libs")
MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}
"""By architecture, as images name it: what wheels call it."""
_FETCH_TIMEOUT = 600


class BuildError(Exception):
    """One sentence that says what to do."""


@dataclass(frozen=True)
class Target:
    """What images are built for.

    Attributes:
        platform: As images name it: ``linux/arm64``.
        machine: As wheels name it: ``aarch64``.
        debian: The image of Debian for it.
        suffix: Of tags on the engine; none for the engine's own architecture.
    """

    platform: str
    machine: str
    debian: str
    suffix: str


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
    packages = locked((ROOT / "requirements.lock").read_text(), environment(machine))
    wanted = closure((canonicalize_name(Requirement(row).name) for row in names), packages)
    return {name: packages[name][0] for name in wanted}


def ros2_requirements(machine: str) -> dict[str, str]:
    """By package, the pinned requirement of ROS 2 for Debian's Python on such a machine."""
    packages = locked((ROOT / "requirements-ros2.lock").read_text(), environment(machine))
    asked = re.findall(r"^[a-z][\w-]*", (ROOT / "requirements-ros2.in").read_text(), re.MULTILINE)
    wanted = closure((name for name in asked if name not in _ROS2_TESTS), packages) - set(_ROS2_LACKS)
    return {name: packages[name][0] for name in wanted}


def environment(machine: str) -> dict[str, str]:
    """What markers of requirements see of Debian's Python on such a machine."""
    return {
        "python_version": PYTHON,
        "python_full_version": f"{PYTHON}.2",
        "implementation_name": "cpython",
        "platform_python_implementation": "CPython",
        "platform_machine": machine,
        "sys_platform": "linux",
        "platform_system": "Linux",
        "os_name": "posix",
    }


def fetch(group: str, machine: str) -> None:
    """Have the wheels of an image, and the list that they are installed from."""
    rows = ros2_requirements(machine) if group == ROS2 else requirements(EXTRAS[group], machine)
    if group not in ("base", ROS2):
        rows = {name: row for name, row in rows.items() if name not in requirements((), machine)}
    text = "\n".join(rows[name] for name in sorted(rows)) + "\n"
    listed, folder = WORK / f"{group}-{machine}.txt", WORK / "wheels" / machine / group
    note = folder / ".complete"
    digest = hashlib.sha256(text.encode()).hexdigest()
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


def context(name: str, machine: str) -> bytes:
    """What an image is built from, as a tar file: its folder, its wheels. Times are left out, for the cache."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as tar:
        tar.add(IMAGES / name, ".", filter=_plain)
        if name in (*EXTRAS, ROS2):
            tar.add(WORK / f"{name}-{machine}.txt", f"{name}.txt", filter=_plain)
            tar.add(WORK / "wheels" / machine / name, f"wheels/{name}", filter=_plain)
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
    """The labels that the Open Container Initiative names; the same for the same commit."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    made_at = os.environ.get("SOURCE_DATE_EPOCH") or _git("log", "-1", "--format=%ct")
    remote = _git("config", "--get", "remote.origin.url")
    said = {
        "title": f"skytether {name}",
        "description": project["description"],
        "version": project["version"],
        "licenses": project["license"],
        "vendor": project["authors"][0]["name"],
        "revision": _git("describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"),
        "created": f"{datetime.fromtimestamp(int(made_at), UTC):%Y-%m-%dT%H:%M:%SZ}" if made_at else "",
        # Any other address is of use to one person only, or has a password in it.
        "source": remote if remote.startswith("https://") and "@" not in remote else "",
    }
    return {f"org.opencontainers.image.{key}": value for key, value in said.items() if value}


def _git(*arguments: str) -> str:
    """What git says of this clone; nothing where it is none."""
    command = [shutil.which("git") or "git", "-C", str(ROOT), *arguments]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    except OSError:
        return ""


def needs(name: str, what: str) -> bool:
    """Whether an image is built on BASE or DEBIAN."""
    return f"ARG {what}" in (IMAGES / name / "Dockerfile").read_text()


def source_tag(name: str, debian_id: str, machine: str) -> str:
    """A tag that says what an image is made from: the same for the same files, wheels and image of Debian."""
    parts = [context(name, machine), debian_id.encode() if needs(name, "DEBIAN") else b""]
    parts += [source_tag("base", debian_id, machine).encode()] if needs(name, "BASE") else []
    return _source(hashlib.sha256(part).digest() for part in parts)


def _source(parts: Iterable[bytes]) -> str:
    return "s-" + hashlib.sha256(b"".join(parts)).hexdigest()[:16]


def sources(client: docker.DockerClient, names: Iterable[str], target: Target) -> dict[str, str]:
    """By image, the tag that says what it is made from."""
    debian_id = str(client.api.inspect_image(target.debian)["Id"])
    return {name: source_tag(name, debian_id, target.machine) for name in names}


def targets(client: docker.DockerClient, platforms: str, debian: str) -> list[Target]:
    """What to build for; the engine's own architecture where nothing is asked for.

    Raises:
        BuildError: The engine has no Debian of such a kind, or cannot run it.
    """
    machine = str(client.info()["Architecture"])
    own = f"linux/{dict(zip(MACHINES.values(), MACHINES, strict=True)).get(machine, machine)}"
    found = []
    for platform in dict.fromkeys(platforms.split(",") if platforms else [own]):
        if platform == own:
            found.append(Target(platform, machine, debian, ""))
            continue
        architecture = platform.removeprefix("linux/")
        if platform != f"linux/{architecture}" or architecture not in MACHINES:
            known = ", ".join(f"linux/{name}" for name in MACHINES)
            raise BuildError(f"nothing can be built for '{platform}': there are {known}")
        name = f"{debian.replace('@sha256:', ':')}-{architecture}"
        _have_foreign(client, debian, name, platform)
        found.append(Target(platform, MACHINES[architecture], name, f"-{architecture}"))
    return found


def _have_foreign(client: docker.DockerClient, debian: str, name: str, platform: str) -> None:
    """Have Debian for another architecture, under a name of its own: the engine keeps one for each name."""
    if not client.images.list(name):
        own = client.api.inspect_image(debian)["Id"] if client.images.list(debian) else None
        try:
            client.images.pull(debian, platform=platform).tag(name)
        except DockerException as error:
            raise BuildError(f"{debian} for {platform} is not on the engine, and cannot be pulled: {error}") from error
        finally:
            if own:
                client.api.tag(own, debian)
    try:
        client.containers.run(name, ["/bin/true"], remove=True, network_disabled=True)
    except DockerException as error:
        raise BuildError(
            f"the engine cannot run {platform}: install qemu-user-static on its machine, or build for {platform} on "
            f"an engine of that kind (DOCKER_HOST), which adds it to the same tags ({error})"
        ) from error


def build(client: docker.DockerClient, name: str, prefix: str, tagged: dict[str, str], target: Target) -> Built:
    """Build one image; what it is built on is there."""
    image = f"{prefix}{name}:{tagged[name]}"
    begun = time.monotonic()
    arguments = {"DEBIAN": target.debian, "BASE": f"{prefix}base:{tagged.get('base', '')}"}
    used = {key: value for key, value in arguments.items() if needs(name, key)}
    lines: list[str] = []
    for line in client.api.build(
        fileobj=io.BytesIO(context(name, target.machine)),
        custom_context=True,
        tag=image,
        buildargs=used,
        labels=labels(name),
        platform=target.platform if target.suffix else None,
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


def arguments() -> argparse.Namespace:
    """What was asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("name", nargs="*", help="default: all of them")
    parser.add_argument("--prefix", default="skytether/", help="before each name on the engine")
    parser.add_argument("--tag", default=TAG, help=f"{SOURCE}: one for each that says what it is made from")
    parser.add_argument("--debian", default="debian:bookworm-slim", help="what the base is built from")
    parser.add_argument("--sbom", type=Path, help="write a list of each image's packages (CycloneDX) into this folder")
    parser.add_argument(
        "--push",
        metavar="HOST[:PORT]/FOLDER",
        help="push to this registry, with the lists of packages; tags: --tag, the version, the one of its source",
    )
    parser.add_argument(
        "--platform", default="", help="linux/amd64,linux/arm64; default: the engine's own; others are emulated"
    )
    parser.add_argument(
        "--digests", type=Path, metavar="FILE", help="write values that give the chart these images, by digest"
    )
    parser.add_argument(
        "--json",
        action="store_true",
        help="print rows `image, seconds, size_mb, numerical_mb`; "
        "with --push rows `image, tags, digest, platforms, replaced`",
    )
    asked = parser.parse_args()
    if asked.digests and not asked.push:
        parser.error("--digests says where images were pushed to: give --push, too")
    return asked


def run(asked: argparse.Namespace, client: docker.DockerClient, pusher: Pusher | None) -> None:
    """Build, and push."""
    names = order(asked.name)
    if pusher:
        pusher.check(names)
    rows: list[Built] = []
    made_from: dict[str, list[str]] = {name: [] for name in names}
    if "base" in names:
        make_wheel()
    for target in targets(client, asked.platform, asked.debian):
        for_it = [name for name in names if name != ROS2 or target.machine == _ROS2_MACHINE]
        if for_it != names:
            if ROS2 in asked.name:
                raise BuildError(f"{ROS2} is for linux/amd64 only, as ROS 2's wheels are")
            print(f"note: {ROS2} is left out for {target.platform}: ROS 2's wheels are for amd64", file=sys.stderr)
        for group in (*EXTRAS, ROS2):
            if group in for_it:
                fetch(group, target.machine)
        source = sources(client, for_it, target) if pusher or asked.tag == SOURCE else {}
        tagged = {name: f"{source[name] if asked.tag == SOURCE else asked.tag}{target.suffix}" for name in for_it}
        debian = client.api.inspect_image(target.debian)["RootFS"]["Layers"] if pusher else []
        for name in for_it:
            rows.append(build(client, name, asked.prefix, tagged, target))
            if asked.sbom:
                write_bill(client, rows[-1].image, asked.sbom)
            if not asked.json:
                print(_line(rows[-1]), flush=True)
            if pusher:
                made = pusher.push(name, rows[-1].image, debian)
                listed = bill(pusher.image(name), made.digest, packages(client, rows[-1].image))
                pusher.attach(name, made, target.platform, listed)
                made_from[name].append(source[name])
    if pusher is None:
        if asked.json:
            print(json.dumps([asdict(row) for row in rows], indent=2))
        return
    pushed = [pusher.tag(name, _tags(asked.tag, made_from[name])) for name in names if made_from[name]]
    if asked.digests:
        asked.digests.write_text(yaml.safe_dump(values(pushed), sort_keys=False))
    _print_pushed(pushed, as_json=asked.json)


def _tags(asked: str, made_from: list[str]) -> list[str]:
    """Where an image is found in the registry."""
    source = made_from[0] if len(made_from) == 1 else _source(tag.encode() for tag in sorted(made_from))
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    return {SOURCE: [source], TAG: [TAG, version, source]}.get(asked, [asked, source])


def _print_pushed(pushed: list[Pushed], *, as_json: bool) -> None:
    if as_json:
        print(json.dumps([asdict(row) for row in pushed], indent=2))
    for row in pushed:
        if not as_json:
            print(f"{row.image}@{row.digest}  {', '.join(row.tags)}  {', '.join(row.platforms)}")
        if row.replaced:
            gone = ", ".join(row.replaced)
            print(f"note: {row.image}:{row.tags[0]} had {gone}, of another commit, and has it no more", file=sys.stderr)
    missing = [f"linux/{name}" for name in MACHINES if any(f"linux/{name}" not in row.platforms for row in pushed)]
    if missing:
        print(
            f"note: nothing was pushed for {', '.join(missing)}: --platform, or the same commit built on an engine of "
            "that kind (DOCKER_HOST), adds it to these tags",
            file=sys.stderr,
        )


def main() -> int:
    """The command."""
    asked = arguments()
    WORK.mkdir(parents=True, exist_ok=True)
    try:
        with ExitStack() as stack:
            # Another run in this clone would take away the wheels that this one packs: it waits for its turn.
            turn = stack.enter_context((WORK / ".lock").open("w"))
            fcntl.flock(turn, fcntl.LOCK_EX)
            client = docker.from_env(timeout=_FETCH_TIMEOUT)
            stack.callback(client.close)
            pusher = None
            if asked.push:
                folder = Path(stack.enter_context(TemporaryDirectory(dir=WORK)))
                pusher = Pusher(client, asked.push, folder)
                stack.callback(pusher.close)
            run(asked, client, pusher)
    except (BuildError, RegistryError, subprocess.TimeoutExpired, DockerException, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def _line(row: Built) -> str:
    without = f", {row.size_mb - row.numerical_mb:.0f} MB without numerical libraries" if row.numerical_mb else ""
    return f"{row.image:40} {row.seconds:6.1f} s {row.size_mb:6.0f} MB{without}"


if __name__ == "__main__":
    sys.exit(main())
