"""What is looked at before a machine joins: each finding a sentence with what to do. Nothing is changed by it."""

from __future__ import annotations

import errno
import ipaddress
import os
import socket
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from skytether.guard.folder import objection

from .machine import EngineInfo, architecture, ask_engine, free_mb, own_addresses

OLDEST_API = (1, 41)
"""Of an engine: Docker 20.10's."""
LEAST_MEMORY_MB = 512
LEAST_DISK_MB = 2048
MOST_OFF_S = 60.0
"""By which the clocks of machine and orchestrator may differ."""
_WILDCARDS = ("0.0.0.0", "::")  # noqa: S104 (nobody listens)
_FEW = 3
"""Ports that are named."""


@dataclass(frozen=True)
class Finding:
    """What one check found."""

    check: str
    says: str
    good: bool = True
    warning: bool = False
    """It is told, and joining goes on."""


def check_engine(path: str) -> tuple[Finding, EngineInfo | None]:
    """Is there an engine that is new enough, and is it one of this machine?"""
    if not Path(path).exists():
        text = (
            f"there is no Docker engine at {path}: install one (apt-get install docker.io), or name its socket with "
            "--engine unix:///PATH"
        )
        return Finding("engine", text, good=False), None
    try:
        found = ask_engine(path)
    except OSError as error:
        advice = "run this as root" if error.errno == errno.EACCES else "`systemctl status docker` says more"
        why = error.strerror or "no answer in time"
        return Finding("engine", f"the Docker engine at {path} does not answer ({why}): {advice}", good=False), None
    except ValueError as error:
        return Finding("engine", f"{error}; name its socket with --engine unix:///PATH", good=False), None
    return judge_engine(found, architecture()), found


def judge_engine(found: EngineInfo, machine: str) -> Finding:
    """Is it new enough, and of this architecture?"""
    try:
        version = tuple(int(part) for part in found.api_version.split(".")[:2])
    except ValueError:
        version = (0, 0)
    if version < OLDEST_API:
        text = (
            f"the Docker engine here is too old: {found.version}, API {found.api_version}; Skytether needs Docker "
            "20.10 (API 1.41) or newer"
        )
        return Finding("engine", text, good=False)
    if found.architecture != machine:
        text = f"the engine runs on {found.architecture}, this machine is {machine}: join the machine of the engine"
        return Finding("engine", text, good=False)
    return Finding("engine", f"Docker {found.version}, {found.architecture}, {found.cpu:g} cores")


def judge_memory(memory_mb: int) -> Finding:
    """Is there enough for a service beside the engine?"""
    if memory_mb < LEAST_MEMORY_MB:
        text = f"this machine has {memory_mb} MiB of memory: a site needs {LEAST_MEMORY_MB} at least"
        return Finding("memory", text, good=False)
    return Finding("memory", f"{memory_mb} MiB")


def judge_disk(free: int | None, folder: str) -> Finding:
    """Is there room for images?"""
    if free is None:
        return Finding("disk", f"the room in {folder} cannot be seen from here", warning=True)
    if free < LEAST_DISK_MB:
        text = (
            f"the disk of {folder} has {free} MiB left, and images need {LEAST_DISK_MB} at least: "
            "`docker system prune` frees what is not used"
        )
        return Finding("disk", text, good=False)
    return Finding("disk", f"{free >> 10} GiB free in {folder}")


def judge_clock(ahead_s: float) -> Finding:
    """Is it the orchestrator's time? ``ahead_s``: by how much that is before ours [s]."""
    if abs(ahead_s) > MOST_OFF_S:
        how = "behind" if ahead_s > 0 else "ahead of"
        text = (
            f"this machine's clock is {_long(abs(ahead_s))} {how} the orchestrator's: set it (timedatectl set-ntp "
            "true; `timedatectl` says whether it follows), then join again, the token is still good"
        )
        return Finding("clock", text, good=False)
    return Finding("clock", f"within {max(1.0, abs(ahead_s)):.0f} s of the orchestrator's")


def _long(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} minutes"


def judge_address(address: str, *, named: bool, orchestrator: str) -> Finding:
    """Can robots be told this address?

    Args:
        address: That they would be told.
        named: Somebody named it.
        orchestrator: The orchestrator's host.
    """
    if address in _WILDCARDS:
        text = f"robots cannot connect to {address}: give the address by which they reach this machine with --advertise"
        return Finding("address", text, good=False)
    if _is_loopback(address) and not _is_loopback(orchestrator):
        text = f"robots elsewhere cannot connect to {address}: give this machine's address with --advertise"
        return Finding("address", text, good=False)
    if named and _is_address(address) and address not in own_addresses():
        text = f"robots are told {address}, which is none of this machine's own: right if a NAT or a relay passes it on"
        return Finding("address", text, warning=True)
    return Finding("address", f"robots are told {address}")


def check_ports(ports: Iterable[int], echo: int | None, why: str = "") -> Finding:
    """Are the UDP ports free that instances and the echo are to have?"""
    wanted = [*ports]
    taken = [port for port in {*wanted, *([echo] if echo else [])} if not _is_free(port)]
    if taken:
        shown = ", ".join(str(port) for port in sorted(taken)[:_FEW]) + (" and others" if len(taken) > _FEW else "")
        option = "--echo-port" if taken == [echo] else "--ports"
        text = (
            f"UDP port {shown} is taken by another program: `ss -lunp 'sport = :{min(taken)}'` names it; end that, or "
            f"give others with {option}"
        )
        return Finding("ports", text, good=False)
    told = f"UDP {wanted[0]} to {wanted[-1]}" if wanted else "UDP ports that the engine chooses"
    return Finding("ports", f"{told}{f', echo on {echo}' if echo else ''}: free{why}")


def check_rights(folder: Path, *, unit: bool) -> Finding:
    """May this be written, and is there a systemd to run it?"""
    if unit and os.geteuid() != 0:
        text = "writing a unit of systemd needs root: run this with sudo, or give --no-unit and run the node yourself"
        return Finding("rights", text, good=False)
    if unit and not Path("/run/systemd/system").is_dir():
        text = "systemd does not run this machine: give --no-unit, and have `skytether site run` started at each boot"
        return Finding("rights", text, good=False)
    above = folder
    while not above.exists() and above != above.parent:
        above = above.parent
    if not os.access(above, os.W_OK):
        return Finding("rights", f"{above} cannot be written: run this with sudo, or give --folder", good=False)
    if why := objection(str(above)):
        text = f"whoever may put another authority beside the keys is this machine's orchestrator: {why}; give --folder"
        return Finding("rights", text, good=False)
    return Finding("rights", f"keys go to {folder}")


def check_disk(engine: EngineInfo) -> Finding:
    """Is there room where the engine keeps its images?"""
    return judge_disk(free_mb(engine.folder), engine.folder or "/")


def _is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("0.0.0.0", port))  # noqa: S104 (nothing is read)
        except OSError as error:
            return error.errno not in (errno.EADDRINUSE, errno.EACCES)
    return True


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _is_loopback(host: str) -> bool:
    return host == "localhost" or (_is_address(host) and ipaddress.ip_address(host).is_loopback)
