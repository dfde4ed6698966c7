"""What a Docker site is told."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from string import ascii_letters, digits
from typing import Annotated, Literal
from urllib.parse import SplitResult, urlsplit

from pydantic import Field, model_validator

from skytether.api.manifest import Device, Strict

from ..base import RuntimeFailure
from ..hosts import AdvertisedHost, BindHost, check_advertised

LOCAL_SOCKET = "/var/run/docker.sock"
Port = Annotated[int, Field(ge=1, le=65_535)]
_NO_NETWORKS = ("host", "none", "default")
"""Words of the engine that are no bridges: with the machine's network, a service could reach all of it."""


_PLAIN = frozenset(ascii_letters + digits + "._:-")
"""Characters of a host and of a user; the colon is an IPv6 address's."""
_OF_FILTERS = ((0, 16), (2, 12))
"""Arguments of sockets by their place: AF_NETLINK, NETLINK_NETFILTER."""
_OURS = str(Path(__file__).with_name("seccomp.json"))


@functools.cache
def _profile(path: str) -> str:
    try:
        return json.dumps(json.loads(Path(path).read_bytes()))
    except (OSError, ValueError) as error:
        raise RuntimeFailure(f"seccomp {path}: {error}") from error


@functools.cache
def _guards_profile() -> str:
    """Ours, and of sockets that to the kernel's netfilter alone: see `skytether.node.seccomp_rules.keeps_in`."""
    profile = json.loads(_profile(_OURS))
    profile["syscalls"] = [entry for entry in profile["syscalls"] if entry["names"] != ["socket"]]
    for entry in profile["syscalls"]:
        entry["names"] = [name for name in entry["names"] if name != "socketpair"]
    arguments = [{"index": at, "value": value, "op": "SCMP_CMP_EQ"} for at, value in _OF_FILTERS]
    profile["syscalls"].append({"names": ["socket"], "action": "SCMP_ACT_ALLOW", "args": arguments})
    return json.dumps(profile)


class TlsOptions(Strict):
    """Both ends prove who they are: an engine behind TCP gives whoever reaches it the whole machine."""

    ca: str
    """File with the authority that signed the engine's certificate."""
    cert: str
    """File with our certificate."""
    key: str
    """File with its key."""


class SshOptions(Strict):
    """For what ``~/.ssh/config`` of the orchestrator's user does not say already."""

    identity: str | None = None
    """File with the private key."""
    known_hosts: str | None = None
    """File with the host's key; an unknown host is refused, never asked for."""


class DockerOptions(Strict):
    """Options of a Docker site."""

    engine: str = f"unix://{LOCAL_SOCKET}"
    """``unix:///PATH``, ``ssh://[USER@]HOST[:PORT][/PATH]`` (PATH: its socket, /var/run/docker.sock unless given),
    ``tcp://HOST:PORT`` with ``tls``, or ``node://SITE`` of a machine that joined, which calls us."""
    tls: TlsOptions | None = None
    ssh: SshOptions = SshOptions()
    bind_host: BindHost | None = None
    """Address (a number, no name) of the engine's machine on which instances are reached; None: loopback of a local
    engine, all addresses of a remote one."""
    advertise_host: AdvertisedHost | None = None
    """Address that robots are told; None: ``bind_host``, or the host of a remote engine."""
    ports: tuple[Port, Port] | None = None
    """First and last UDP port that instances may have, as a firewall lets them through; None: the engine chooses."""
    cpu: Annotated[float, Field(gt=0)] | None = None
    """Cores that instances may ask for in all; None: all of the engine's."""
    memory_mb: Annotated[int, Field(gt=0)] | None = None
    """None: all of the engine's."""
    gpu: Annotated[int, Field(ge=0)] = 0
    """GPUs; each instance gets its own, by number. The engine needs NVIDIA's container toolkit."""
    devices: tuple[Device, ...] = ()
    """Device files that services may ask for, such as /dev/video0."""
    groups: tuple[Annotated[int, Field(ge=1, lt=1 << 31)], ...] = ()
    """Numbers of the groups that own these files on the engine's machine (``stat -c %g /dev/video0``): a service that
    asks for a device is in them, and may open it where it is not open to all."""
    data_mb: Annotated[int, Field(ge=1)] = 20_480
    """MiB in the volume that keeps what one service writes for one robot; what writes beyond is ended, and not started
    until there is room. Looked at every half minute: a fast writer goes over it until then."""
    pull: Literal["missing", "always", "never"] = "missing"
    """When to fetch a service's image from its registry. `skytether/...` without a registry is never fetched but by its
    digest: these are built here (`make images`), and anybody may have the name elsewhere."""
    pinned: bool = False
    """Take only images that are named with their digest, NAME@sha256:..."""
    signers: tuple[Annotated[str, Field(pattern=r"^[A-Za-z0-9+/]{43}=$")], ...] = ()
    """Public keys (Ed25519, 32 bytes in base64) one of which must have signed each image, the guard's too; none: images
    need no signature."""
    signatures: str | None = None
    """Folder with the signatures, on the orchestrator's machine."""
    registry_auth: str | None = None
    """File with the credentials of private registries, as ``docker login`` writes it (config.json); mode 0600."""
    network: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,127}$")] = "skytether"
    """The instances' network. It is made if it is not there, and each instance in it closed off: robots reach it, it
    reaches nobody but by ``egress``. One that somebody else made is used as it is."""
    egress: tuple[Annotated[str, Field(min_length=1, max_length=300)], ...] = ()
    """Patterns of what manifests may open (``needs.egress``), such as ``*.example.org:443/tcp``; ``*`` is everything,
    this machine and its neighbours included."""
    guard_image: Annotated[str, Field(min_length=1)] = "skytether/guard:1"
    """Runs once for each instance's network, to close that off, with no right to any other; and sleeps, with no right
    at all, in those that are ``prepared``. Never pulled, unless it is named with its digest."""
    prepared: Annotated[int, Field(ge=0, le=16)] = 1
    """Networks that are closed off before anybody asks, each held by a container that sleeps. A start that finds one
    waits for no guard; one whose service opens something, or that gets one of ``ports``, makes its own."""
    seccomp: str | None = None
    """File with another profile of the calls that services may make, as ``docker run`` takes it; ``default``: the
    engine's own; None: ours (``seccomp.json``), which lets through less."""
    without_limits: bool = False
    """Use an engine that holds no limits of memory, processor or processes, as rootless ones do without cgroup 2: one
    service could starve all others."""
    environment: dict[Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")], str] = {}
    """More variables for the services. No secrets: whoever may ask the engine sees them."""
    owner: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,31}$")] | None = None
    """Under this name containers are found again; None: one is made up when the site is added."""
    timeout_s: Annotated[float, Field(gt=0, le=300)] = 10.0
    """An engine that has not answered for this long is unreachable."""

    @property
    def security(self) -> list[str]:
        """The engine's options for each container.

        Raises:
            RuntimeFailure: The profile cannot be read.
        """
        own = ["no-new-privileges"]
        return own if self.seccomp == "default" else [*own, f"seccomp={_profile(self.seccomp or _OURS)}"]

    @property
    def guard_security(self) -> list[str]:
        """The same for a guard, which has a right to its network: by a socket for routes it were one to all of them."""
        closed = self.seccomp != "default" or self.address.scheme == "node"  # an engine may have no seccomp at all
        return ["no-new-privileges", f"seccomp={_guards_profile()}"] if closed else self.security

    @property
    def address(self) -> SplitResult:
        return urlsplit(self.engine)

    @property
    def local(self) -> bool:
        return self.address.scheme == "unix"

    @property
    def bound(self) -> str:
        """Where instances listen."""
        return self.bind_host or ("127.0.0.1" if self.local else "0.0.0.0")  # noqa: S104 (a remote one is for others)

    @property
    def advertised(self) -> str:
        """Where robots find them."""
        return self.advertise_host or (self.bind_host if self.local else self.address.hostname) or self.bound

    @model_validator(mode="after")
    def _engine_can_be_reached(self) -> DockerOptions:
        try:
            address = self.address
            complete = bool(address.path) if self.local else bool(address.hostname)
            port = address.port  # raises if it is none
            complete = complete and (address.scheme != "tcp" or port is not None)
        except ValueError as error:
            raise ValueError(f"engine: {error}") from None
        if address.scheme not in ("unix", "ssh", "tcp", "node") or not complete:
            raise ValueError("engine must be unix:///PATH, ssh://[USER@]HOST[:PORT] or tcp://HOST:PORT")
        if address.scheme == "node" and self.advertise_host is None:
            raise ValueError("advertise_host is needed with node://: the machine says it when it joins")
        for what in (address.username, address.hostname):
            # The SSH client may put them into a shell's command of ~/.ssh/config (ProxyCommand, Match exec).
            if what and (what.startswith("-") or not set(what) <= _PLAIN):
                raise ValueError(
                    "engine: user and host have letters, digits and . _ : - only, and do not begin with '-'"
                )
        if address.password:
            raise ValueError("engine: no password belongs into the address; use a key, see ssh.identity")
        if (address.scheme == "tcp") != (self.tls is not None):
            raise ValueError("tls (ca, cert, key) goes with tcp://, and tcp:// with tls: without it anyone is let in")
        return self

    @model_validator(mode="after")
    def _robots_can_connect(self) -> DockerOptions:
        check_advertised(self.advertised)
        if bool(self.signers) != (self.signatures is not None):
            raise ValueError("signers and signatures go together: the keys, and the folder with what they signed")
        if self.network in _NO_NETWORKS:
            raise ValueError(f"network: '{self.network}' has no published ports, by which robots reach instances")
        if self.ports is not None and self.ports[0] > self.ports[1]:
            raise ValueError("ports: the first is above the last")
        return self
