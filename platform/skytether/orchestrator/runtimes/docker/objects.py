"""What is asked of an engine, and what its answers mean: pure, data in and data out."""

from __future__ import annotations

import io
import tarfile
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from skytether.api.grant import GRANT_VARIABLE
from skytether.api.manifest import ServiceSpec

from ..base import Launch, Observation, Phase
from .egress import refusal_of
from .meter import Usage
from .options import DockerOptions

USER = 65_532
"""Who every service is, and who owns its files; nobody on the engine's machine."""
INNER_PORT = 7600
"""UDP port inside the container; robots are told the one that is published."""
_ROOT = "/run/skytether"
_OWN = "instance"
"""Folder of the grant and the ready file; only the service can read it."""
GRANT = f"{_ROOT}/{_OWN}/grant.json"
READY = f"{_ROOT}/{_OWN}/ready.json"
_DATA = "data"
_LOG = {"max-size": "2m", "max-file": "2"}
"""The engine keeps at most this of each run's log."""
_TMPFS = "size=64m,mode=1777,nosuid,nodev"
"""Of /tmp; it counts as memory of the container."""
_PREFIX = "skytether.io"
OWNER = f"{_PREFIX}/owner"
_INSTANCE, _ATTEMPT, _GPUS = f"{_PREFIX}/instance", f"{_PREFIX}/attempt", f"{_PREFIX}/gpus"
_SIGNALLED, _SIGNALS = 128, 64
"""An exit status above the first means the signal that is left, as far as there are any: 255 is a program's own -1."""
_LEAST_CORES = 0.01
"""The kernel gives no less."""
_ADVICE = (
    ("could not select device driver", "the engine has no NVIDIA container toolkit: install it, or set 'gpu' to 0"),
    ("error gathering device information", "plug it in, or take it out of the site's option 'devices'"),
    ("cannot assign requested address", "the site's option 'bind_host' is no address of the engine's machine"),
)
"""What to do about what an engine says."""


@dataclass(frozen=True, slots=True)
class Seen:
    """One container of ours as the engine describes it."""

    id: str
    instance: str
    attempt: int
    status: str
    """``created``, ``running``, ``paused``, ``exited``, ``dead``, ``removing``."""
    exit_code: int = 0
    out_of_memory: bool = False
    memory_limit: int = 0
    host_port: int | None = None
    """Published UDP port; known while it runs."""
    ill: str = ""
    """What its health check says, when that has failed for good."""
    gpus: frozenset[int] = frozenset()
    volume: str = ""
    """That of its data."""
    ready: bool = False
    """Its ready file was seen."""
    last_line: str = ""
    """When it has ended."""

    @property
    def runs(self) -> bool:
        return self.status in ("running", "paused")

    @property
    def ended(self) -> bool:
        return self.status in ("exited", "dead", "removing")


def name_of(owner: str, instance: str, attempt: int) -> str:
    """A container's name."""
    return f"skytether-{owner}-{instance}-{attempt}"


def data_volume(owner: str, launch: Launch) -> str:
    """The volume that keeps what one service writes for one robot, over all its instances.

    Names have hyphens: between two of them a dot says where the one ends, which is part of neither. Where there is no
    other hyphen there is nothing to mistake, and the volume has the name that it always had.
    """
    robot, service = launch.grant.robot, launch.grant.service
    return f"skytether-{owner}-data-{robot}{'.' if '-' in robot + service else '-'}{service}"


def refusal(spec: ServiceSpec, options: DockerOptions) -> str | None:
    """Why a site with these options can never run the service; None: it can."""
    if not spec.image:
        return "the service has no image, only an entrypoint: it needs a process site"
    if options.pinned and "@sha256:" not in spec.image:
        return f"image '{spec.image}' is named without its digest, and the site takes pinned images only"
    missing = [device for device in spec.needs.devices if device not in options.devices]
    if missing:
        return f"the site does not offer {', '.join(missing)}: add it to the site's option 'devices'"
    return refusal_of(spec.needs.openings, options.egress)


def free_gpus(wanted: int, total: int, taken: Iterable[int]) -> tuple[int, ...] | None:
    """The numbers of GPUs that nobody has; None: there are too few."""
    free = [number for number in range(total) if number not in set(taken)]
    return tuple(free[:wanted]) if len(free) >= wanted else None


def free_port(ports: tuple[int, int] | None, preferred: int | None, taken: Iterable[int]) -> int | None:
    """The UDP port to publish: the one of the run before, or the first free one; None: the engine's choice.

    Raises:
        LookupError: All of them are taken.
    """
    used = set(taken)
    if preferred is not None and preferred not in used and (ports is None or ports[0] <= preferred <= ports[1]):
        return preferred
    if ports is None:
        return None
    return next(port for port in range(ports[0], ports[1] + 1) if port not in used)


def advised(refusal: str) -> str:
    """An engine's refusal, with what to do about it where that is known."""
    return next((f"{refusal}; {what}" for words, what in _ADVICE if words in refusal), refusal)


def container(
    launch: Launch,
    options: DockerOptions,
    owner: str,
    image: str,
    port: int | None,
    gpus: tuple[int, ...],
    cores: float,
    hosts: Mapping[str, Iterable[str]],
) -> dict[str, Any]:
    """The body of the engine's call that creates a container.

    Args:
        launch: What to start.
        options: The site's.
        owner: Whose containers these are.
        image: The image's id: what a tag means may change between two runs.
        port: UDP port to publish; None: the engine's choice.
        gpus: Numbers of its GPUs.
        cores: Of the engine's machine, which refuses a limit above them.
        hosts: Addresses of the names that it may connect to.
    """
    spec, grant = launch.spec, launch.grant
    inner = f"{INNER_PORT}/udp"
    memory = (spec.limits.memory_mb or spec.needs.memory_mb) << 20
    limit = max(_LEAST_CORES, min(spec.limits.cpu or max(1.0, spec.needs.cpu), cores))
    environment = {**options.environment, GRANT_VARIABLE: GRANT}
    return {
        "Image": image,
        "User": f"{USER}:{USER}",
        "Env": [f"{key}={value}" for key, value in environment.items()],
        "ExposedPorts": {inner: {}},
        "Labels": {
            OWNER: owner,
            _INSTANCE: grant.instance,
            _ATTEMPT: str(launch.attempt),
            _GPUS: ",".join(map(str, gpus)),
            f"{_PREFIX}/robot": grant.robot,
            f"{_PREFIX}/service": grant.service,
            "app.kubernetes.io/name": grant.service,
            "app.kubernetes.io/instance": grant.instance,
            "app.kubernetes.io/managed-by": "skytether",
        },
        "HostConfig": {
            "NetworkMode": options.network,
            "PortBindings": {inner: [{"HostIp": options.bound, "HostPort": str(port or "")}]},
            "Dns": ["127.0.0.1"],  # nobody to ask: names would be a way out
            "ExtraHosts": [f"{name}:{address}" for name, addresses in hosts.items() for address in addresses],
            "Init": True,  # as process 1, a service that has no handler yet could not be ended
            "ReadonlyRootfs": True,
            "CapDrop": ["ALL"],
            "SecurityOpt": options.security,
            "Memory": memory,
            "MemorySwap": memory,  # none beyond it: a service that swaps is of no use to a robot
            "NanoCpus": int(limit * 1e9),
            "CpuShares": max(2, int(spec.needs.cpu * 1024)),
            "PidsLimit": spec.limits.pids,
            "Tmpfs": {"/tmp": _TMPFS},  # noqa: S108 (the container's own)
            "Mounts": [
                {"Type": "volume", "Target": _ROOT},
                {"Type": "volume", "Source": data_volume(owner, launch), "Target": f"{_ROOT}/{_DATA}"},
            ],
            "Devices": [
                {"PathOnHost": device, "PathInContainer": device, "CgroupPermissions": "rw"}
                for device in spec.needs.devices
            ],
            "GroupAdd": [str(group) for group in options.groups] if spec.needs.devices else [],
            "DeviceRequests": _gpu_requests(gpus),
            "LogConfig": {"Type": "json-file", "Config": _LOG},
        },
    }


def _gpu_requests(gpus: tuple[int, ...]) -> list[dict[str, Any]]:
    if not gpus:
        return []
    return [{"Driver": "nvidia", "DeviceIDs": [str(number) for number in gpus], "Capabilities": [["gpu"]]}]


def grant_archive(launch: Launch) -> tuple[str, bytes]:
    """A folder of the container, and the tar file to unpack there before it starts: the grant, for the service alone.

    The key goes this way, into a volume that is removed with the container, and no other.
    """
    data = f"{_DATA}/{launch.instance}"
    bound = {"bind_host": "0.0.0.0", "bind_port": INNER_PORT, "ready_file": READY, "data_dir": f"{_ROOT}/{data}"}  # noqa: S104 (in its own network)
    grant = launch.grant.model_copy(update=bound).model_dump_json().encode()
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as tar:
        for folder in (_OWN, _DATA, data):
            tar.addfile(_owned(folder, 0o700, tarfile.DIRTYPE))
        entry = _owned(f"{_OWN}/grant.json", 0o400, tarfile.REGTYPE)
        entry.size = len(grant)
        tar.addfile(entry, io.BytesIO(grant))
    return _ROOT, buffer.getvalue()


def _owned(path: str, mode: int, kind: bytes) -> tarfile.TarInfo:
    entry = tarfile.TarInfo(path)
    entry.type, entry.mode, entry.uid, entry.gid = kind, mode, USER, USER
    return entry


def parse(inspected: Mapping[str, Any]) -> Seen | None:
    """A container out of the engine's description; None: it is not one of ours."""
    labels = inspected["Config"].get("Labels") or {}
    if _INSTANCE not in labels or not labels.get(_ATTEMPT, "").isdecimal():
        return None
    state = inspected["State"]
    published = (inspected["NetworkSettings"].get("Ports") or {}).get(f"{INNER_PORT}/udp") or []
    health = state.get("Health") or {}
    mounts = inspected.get("Mounts") or ()
    return Seen(
        id=inspected["Id"],
        instance=labels[_INSTANCE],
        attempt=int(labels[_ATTEMPT]),
        status=state["Status"],
        exit_code=state["ExitCode"],
        out_of_memory=state["OOMKilled"],
        memory_limit=inspected["HostConfig"]["Memory"],
        host_port=int(published[0]["HostPort"]) if published else None,
        ill=_complaint(health) if health.get("Status") == "unhealthy" else "",
        gpus=frozenset(int(number) for number in labels.get(_GPUS, "").split(",") if number.isdecimal()),
        volume=next((str(m.get("Name", "")) for m in mounts if m.get("Destination") == f"{_ROOT}/{_DATA}"), ""),
    )


def _complaint(health: Mapping[str, Any]) -> str:
    outputs = [entry.get("Output", "").strip() for entry in health.get("Log") or []]
    return last_line(outputs[-1]) if outputs and outputs[-1] else "its health check fails"


def last_line(text: str) -> str:
    """The last line that can be read, at most 300 characters of it."""
    for line in reversed(text.split("\n")):
        readable = "".join(c for c in line if c.isprintable()).strip()
        if readable:
            return readable[:300]
    return ""


def carried_over(new: Seen, old: Seen | None) -> Seen:
    """What one look knows that the next cannot find out again."""
    if old is None:
        return new
    return replace(
        new,
        ready=new.ready or old.ready,
        host_port=new.host_port or old.host_port,
        last_line=new.last_line or old.last_line,
    )


def observation(seen: Seen, options: DockerOptions, usage: Usage | None = None, exceeds: str = "") -> Observation:
    """What the contract calls it; ``exceeds``: what it wrote too much of."""
    if seen.ended:
        signalled = _SIGNALLED < seen.exit_code <= _SIGNALLED + _SIGNALS
        return Observation(
            seen.attempt,
            Phase.EXITED,
            exit_status=_SIGNALLED - seen.exit_code if signalled else seen.exit_code,
            last_line=seen.last_line,
            detail=_how_it_ended(seen),
        )
    if seen.runs and seen.ready and seen.host_port is not None:
        used = asdict(usage) if usage is not None else {}
        where = options.advertised, seen.host_port
        return Observation(seen.attempt, Phase.RUNNING, *where, detail=seen.ill, exceeds=exceeds, **used)
    return Observation(seen.attempt, Phase.STARTING, exceeds=exceeds)


def _how_it_ended(seen: Seen) -> str:
    if seen.out_of_memory and seen.exit_code:
        return f"ran out of memory: its limit is {seen.memory_limit >> 20} MiB (limits.memory_mb of its manifest)"
    return ""
