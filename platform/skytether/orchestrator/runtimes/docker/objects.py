"""What is asked of an engine: pure, data in and data out. What its answers mean is in `seen`."""

from __future__ import annotations

import io
import itertools
import posixpath
import tarfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from skytether.api.grant import GRANT_VARIABLE
from skytether.api.health_check import is_borne
from skytether.api.manifest import ServiceSpec
from skytether.api.service_report import FILE_NAME

from ..base import Launch, RuntimeFailure
from ..containers import (
    INNER_PORT,
    USER,
    data_name,
    image_refusal,
)
from ..egress import refusal_of
from .limits import limits_of, parent_of
from .options import DockerOptions

_ROOT = "/run/skytether"
_OWN = "instance"
"""Folder of the grant and the ready file; only the service can read it."""
GRANT = f"{_ROOT}/{_OWN}/grant.json"
READY = f"{_ROOT}/{_OWN}/ready.json"
REPORTS = f"{_ROOT}/{_OWN}/{FILE_NAME}"
DATA_FOLDER = "/var/lib/skytether"
"""Where the volume is for what a service writes: in no other volume, or what runs could have an engine mount it at any
folder of the machine. An engine looks into containers that run, and mounts their volumes for that, from the outside."""
DATA_BEFORE = f"{_ROOT}/data"
"""Where earlier releases had it."""
_LOG = {"max-size": "2m", "max-file": "2"}
"""The engine keeps at most this of each run's log."""
_TMP = "/tmp"  # noqa: S108 (the container's own)
_TMPFS = "size=64m,mode=1777,nosuid,nodev"
"""Of /tmp; it counts as memory of the container."""
_PREFIX = "skytether.io"
OWNER = f"{_PREFIX}/owner"
INSTANCE, ATTEMPT, GPUS = f"{_PREFIX}/instance", f"{_PREFIX}/attempt", f"{_PREFIX}/gpus"
NAMESPACE, PORT = f"{_PREFIX}/namespace", f"{_PREFIX}/port"
"""Of an instance in a network that was prepared: the container that holds it, and the UDP port published there."""
EPOCH = f"{_PREFIX}/epoch"
"""Of containers: of the leader who had them made. Of volumes: who led here last."""
BESIDE = f"{_PREFIX}/beside"
"""Of volumes that go with their containers: the volume of data that the container has."""
HELPER = f"{_PREFIX}/helper"
"""Of the other containers of ours: whom a guard closes off, and nobody where it holds a network namespace."""
INNER = f"{INNER_PORT}/udp"
_EXPOSED: dict[str, dict[str, str]] = {INNER: {}}
_MANAGED = {"app.kubernetes.io/managed-by": "skytether"}
_HELPS = {"Init": True, "ReadonlyRootfs": True, "PidsLimit": 16, "Memory": 64 << 20, "IpcMode": "none"}
"""Of whom no service is asked."""
_MOST_VOLUMES = 32
"""That an image may declare: an engine makes, mounts and removes each of them, and answers nobody meanwhile."""
_LEAST_BETWEEN_CHECKS = {"Interval": 1_000_000_000, "StartInterval": 1_000_000_000}
"""Nanoseconds between two checks of an image's health: each costs the engine more than the container, whose limits do
not hold for that."""
_ADVICE = (
    ("could not select device driver", "the engine has no NVIDIA container toolkit: install it, or set 'gpu' to 0"),
    ("error gathering device information", "plug it in, or take it out of the site's option 'devices'"),
    ("cannot assign requested address", "the site's option 'bind_host' is no address of the engine's machine"),
)
"""What to do about what an engine says."""


@dataclass(frozen=True, slots=True)
class Namespace:
    """A network namespace that is closed off already."""

    id: str
    """Of the container that holds it."""
    name: str
    """Of that container."""
    port: int
    """Published UDP port."""


def name_of(owner: str, instance: str, attempt: int) -> str:
    """A container's name."""
    return f"skytether-{owner}-{instance}-{attempt}"


def data_volume(owner: str, launch: Launch) -> str:
    """The volume that keeps what one service writes for one robot, over all its instances."""
    return data_name(owner, launch.grant.robot, launch.grant.service)


def epoch_volume(owner: str, epoch: int) -> tuple[str, dict[str, str]]:
    """Name and labels of the volume that says who leads."""
    return f"skytether-{owner}-epoch-{epoch}", {OWNER: owner, EPOCH: str(epoch), **_MANAGED}


def stored_by_robot(owner: str, sizes: Mapping[str, int]) -> dict[str, int]:
    """Bytes by robot, of the data volumes among an engine's: see `data_volume`."""
    before, found = f"skytether-{owner}-data-", Counter[str]()
    for volume, size in sizes.items():
        rest = volume.removeprefix(before)
        if rest != volume:
            found[rest.partition("." if "." in rest else "-")[0]] += size
    return dict(found)


def refusal(spec: ServiceSpec, options: DockerOptions) -> str | None:
    """Why a site with these options can never run the service; None: it can."""
    if refused := image_refusal(spec, pinned=options.pinned):
        return refused
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


class Declared(NamedTuple):
    """What an image says of itself, whoever made it."""

    id: str
    """What a tag means may change between two runs."""
    volumes: tuple[str, ...] = ()
    """Paths."""
    checks: Mapping[str, int] = {}
    """Of its health check, what would be done too often, as it is done instead [ns]."""


def declared(image: str, inspected: Mapping[str, Any]) -> Declared:
    """What matters of the engine's description of an image.

    Args:
        image: Its id.
        inspected: The description.

    Raises:
        RuntimeFailure: It asks for too much, or for what ends an engine.
    """
    config = inspected.get("Config") or {}
    volumes, health = tuple(config.get("Volumes") or ()), config.get("Healthcheck") or {}
    if len(volumes) > _MOST_VOLUMES:
        raise RuntimeFailure(f"its image declares {len(volumes)} volumes, and may declare {_MOST_VOLUMES}")
    paths = {_ROOT, DATA_FOLDER, *(posixpath.normpath(f"/{path.lstrip('/')}") for path in volumes)}
    for inner, outer in itertools.permutations(sorted(paths), 2):
        if inner.startswith(f"{outer.rstrip('/')}/"):
            raise RuntimeFailure(f"its image declares volumes so that {inner} is in {outer}; none may be in another")
    if not is_borne(test := health.get("Test")):
        raise RuntimeFailure(f"its image declares the health check {str(test)[:80]}, which has no command")
    # Where it says 0 the engine's own holds, half a minute.
    return Declared(
        image, volumes, {key: least for key, least in _LEAST_BETWEEN_CHECKS.items() if 0 != health.get(key, 0) < least}
    )


def container(
    launch: Launch,
    options: DockerOptions,
    owner: str,
    image: Declared,
    port: int | None,
    gpus: tuple[int, ...],
    info: Mapping[str, Any],
    hosts: Mapping[str, Iterable[str]],
    namespace: Namespace | None = None,
    *,
    epoch: int = 0,
) -> dict[str, Any]:
    """The body of the engine's call that creates a container.

    Args:
        launch: What to start.
        options: The site's.
        owner: Whose containers these are.
        image: The image.
        port: UDP port to publish; None: the engine's choice.
        gpus: Numbers of its GPUs.
        info: What the engine says of itself and its machine.
        hosts: Addresses of the names that it may connect to.
        namespace: The network that it is to join, which says what is published; None: one of its own.
        epoch: Of the leader; 0: there is none.
    """
    spec, grant = launch.spec, launch.grant
    environment = {**options.environment, GRANT_VARIABLE: GRANT}
    whose = {f"{_PREFIX}/robot": grant.robot, f"{_PREFIX}/service": grant.service, **_MANAGED}
    paths = {posixpath.normpath(path) for path in image.volumes} - {_ROOT, DATA_FOLDER, _TMP}
    data = data_volume(owner, launch)
    return {
        "Image": image.id,
        # The rest of the check stays the image's.
        **({"Healthcheck": dict(image.checks)} if image.checks else {}),
        "User": f"{USER}:{USER}",
        "Env": [f"{key}={value}" for key, value in environment.items()],
        **({} if namespace else {"ExposedPorts": _EXPOSED}),
        "Labels": {
            OWNER: owner,
            **({NAMESPACE: namespace.id, PORT: str(namespace.port)} if namespace else {}),
            INSTANCE: grant.instance,
            ATTEMPT: str(launch.attempt),
            GPUS: ",".join(map(str, gpus)),
            **({EPOCH: str(epoch)} if epoch else {}),
            "app.kubernetes.io/name": grant.service,
            "app.kubernetes.io/instance": grant.instance,
            **whose,
        },
        "HostConfig": {
            **({"NetworkMode": f"container:{namespace.id}"} if namespace else _reached(options, port, hosts)),
            "Init": True,  # as process 1, a service that has no handler yet could not be ended
            "ReadonlyRootfs": True,
            "CapDrop": ["ALL"],
            "SecurityOpt": options.security,
            **limits_of(spec, float(info["NCPU"])).document(),
            **parent_of(info),
            "PidsLimit": spec.limits.pids,
            "Tmpfs": {_TMP: _TMPFS},
            "Mounts": [
                # By their labels they are found, should somebody remove the container without them.
                *(
                    _volume(path, {OWNER: owner, INSTANCE: grant.instance, BESIDE: data, **_MANAGED})
                    for path in [_ROOT, *sorted(paths)]
                ),
                _volume(DATA_FOLDER, {OWNER: owner, **whose}, data),
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


def _volume(path: str, labels: Mapping[str, str], name: str | None = None) -> dict[str, Any]:
    """``name``: of one that stays; None: it goes with its container."""
    options: dict[str, Any] = {"Labels": dict(labels)}
    if name is None:
        return {"Type": "volume", "Target": path, "VolumeOptions": options}
    # With a copy of what the image has there, an engine would follow links that another container puts there meanwhile.
    return {"Type": "volume", "Source": name, "Target": path, "VolumeOptions": {**options, "NoCopy": True}}


def _reached(options: DockerOptions, port: int | None, hosts: Mapping[str, Iterable[str]]) -> dict[str, Any]:
    """How a container is reached, and whom it knows by name."""
    return {
        "NetworkMode": options.network,
        "PortBindings": {INNER: [{"HostIp": options.bound, "HostPort": str(port or "")}]},
        "Dns": ["127.0.0.1"],  # nobody to ask: names would be a way out
        "ExtraHosts": [f"{name}:{address}" for name, addresses in hosts.items() for address in addresses],
    }


def holder(options: DockerOptions, owner: str, image: str) -> dict[str, Any]:
    """The body of the call that creates a container which holds a network namespace, sleeps, and has no right."""
    return {
        "Image": image,
        "Entrypoint": ["/bin/sleep"],
        "Cmd": ["infinity"],
        "User": f"{USER}:{USER}",
        "ExposedPorts": _EXPOSED,
        "HostConfig": {**_reached(options, None, {}), **_HELPS, "CapDrop": ["ALL"], "SecurityOpt": options.security},
        "Labels": {OWNER: owner, HELPER: "", **_MANAGED},
    }


def guard(options: DockerOptions, owner: str, image: str, target: str, script: str) -> dict[str, Any]:
    """The body of the call that creates a container in which nftables does what a script says in another's network."""
    return {
        "Image": image,
        "Entrypoint": ["/usr/sbin/nft"],
        "Cmd": [script],
        "User": "0:0",  # the right below is root's alone; it goes for the network of that container only
        "HostConfig": {
            "NetworkMode": f"container:{target}",
            **_HELPS,
            "CapDrop": ["ALL"],
            "CapAdd": ["NET_ADMIN"],
            "SecurityOpt": options.guard_security,
        },
        "Labels": {OWNER: owner, HELPER: target, **_MANAGED},
    }


def _gpu_requests(gpus: tuple[int, ...]) -> list[dict[str, Any]]:
    if not gpus:
        return []
    return [{"Driver": "nvidia", "DeviceIDs": [str(number) for number in gpus], "Capabilities": [["gpu"]]}]


def archives(launch: Launch) -> Iterator[tuple[str, bytes]]:
    """Folders of the container, and the tar file to unpack in each before it starts, for the service alone.

    The key goes this way, into a volume that is removed with the container, and no other.
    """
    data_dir = f"{DATA_FOLDER}/{launch.instance}"
    bound = {"bind_host": "0.0.0.0", "bind_port": INNER_PORT, "ready_file": READY, "data_dir": data_dir}  # noqa: S104 (in its own network)
    grant = launch.grant.model_copy(update=bound).model_dump_json().encode()
    entry = _owned(f"{_OWN}/grant.json", 0o400, tarfile.REGTYPE)
    entry.size = len(grant)
    yield _ROOT, _archive(_owned(_OWN, 0o700, tarfile.DIRTYPE), (entry, grant))
    yield DATA_FOLDER, _archive(_owned(launch.instance, 0o700, tarfile.DIRTYPE))


def _archive(folder: tarfile.TarInfo, *files: tuple[tarfile.TarInfo, bytes]) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as tar:
        tar.addfile(folder)
        for entry, content in files:
            tar.addfile(entry, io.BytesIO(content))
    return buffer.getvalue()


def _owned(path: str, mode: int, kind: bytes) -> tarfile.TarInfo:
    entry = tarfile.TarInfo(path)
    entry.type, entry.mode, entry.uid, entry.gid = kind, mode, USER, USER
    return entry
