"""What an engine's answers mean: pure, data in and data out."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from skytether.api.service_report import ServiceReport

from ..base import Observation, Phase
from ..containers import exit_status, last_line, out_of_memory
from .limits import NO_LIMITS, ContainerLimits, pull_limits
from .meter import Usage
from .objects import ATTEMPT, DATA_BEFORE, DATA_FOLDER, GPUS, HELPER, INNER, INSTANCE, NAMESPACE, PORT
from .options import DockerOptions

_LONGEST = 200
"""Characters of a word that an engine says of itself, and words of a list."""

_NUMBER = re.compile("[0-9]{1,18}")


@dataclass(frozen=True, slots=True)
class Helper:
    """A container of ours that is no service."""

    name: str
    runs: bool
    target: str
    """The container that this guard closes off; empty: it is no guard, and holds a network namespace."""


@dataclass(frozen=True, slots=True)
class ContainerState:
    """One container of ours as the engine describes it."""

    id: str
    instance: str
    attempt: int
    status: str
    """``created``, ``running``, ``paused``, ``exited``, ``dead``, ``removing``."""
    exit_code: int = 0
    out_of_memory: bool = False
    limits: ContainerLimits = NO_LIMITS
    host_port: int | None = None
    """Published UDP port; known while it runs."""
    ill: str = ""
    """What its health check says, when that has failed for good."""
    gpus: frozenset[int] = frozenset()
    volume: str = ""
    """That of its data."""
    other_volumes: tuple[str, ...] = ()
    namespace: str = ""
    """The container that holds its network; empty: it does itself."""
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


def pull_machine(info: Any) -> Mapping[str, Any]:
    """What an engine says of itself, of the kinds that are reckoned with here, and short.

    Raises:
        ValueError: Some of it is of another kind.
    """
    if not isinstance(info, Mapping):
        raise ValueError("it says nothing of itself")
    kinds = {"NCPU": (int, float), "MemTotal": (int,), "Architecture": (str,), "SystemTime": (str,)}
    for key, kind in kinds.items():
        value = info.get(key, "")
        if not isinstance(value, kind) or len(str(value)) > _LONGEST:
            raise ValueError(f"its {key} is not what it should be")
    security = info.get("SecurityOptions") or ()
    if not isinstance(security, list | tuple) or len(security) > _LONGEST or not all(_is_word(row) for row in security):
        raise ValueError("its SecurityOptions are not what they should be")
    return info


def _is_word(value: object) -> bool:
    return isinstance(value, str) and len(value) <= _LONGEST


def parse(inspected: Mapping[str, Any]) -> ContainerState | None:
    """A container out of the engine's description; None: it is not one of ours."""
    labels = inspected["Config"].get("Labels") or {}
    attempt = _number(labels.get(ATTEMPT))
    if INSTANCE not in labels or attempt is None:
        return None
    state = inspected["State"]
    port = published_port(inspected)
    health = state.get("Health") or {}
    volumes = {mount.get("Destination"): str(mount.get("Name", "")) for mount in inspected.get("Mounts") or ()}
    return ContainerState(
        id=inspected["Id"],
        instance=labels[INSTANCE],
        attempt=attempt,
        status=state["Status"],
        exit_code=state["ExitCode"],
        out_of_memory=state["OOMKilled"],
        limits=pull_limits(inspected["HostConfig"]),
        host_port=port or _port(labels.get(PORT)),
        ill=_complaint(health.get("Log") or ()) if health.get("Status") == "unhealthy" else "",
        gpus=frozenset(gpu for number in labels.get(GPUS, "").split(",") if (gpu := _number(number)) is not None),
        volume=volumes.pop(DATA_FOLDER, "") or volumes.pop(DATA_BEFORE, ""),
        other_volumes=tuple(volumes.values()),
        namespace=labels.get(NAMESPACE, ""),
    )


def published_port(inspected: Mapping[str, Any]) -> int | None:
    """Where a container is reached on its engine's machine; None: nowhere, or its network is another's."""
    published = (inspected["NetworkSettings"].get("Ports") or {}).get(INNER) or []
    return _port(published[0]["HostPort"]) if published else None


def _port(told: Any) -> int | None:
    """A robot is sent there, so it is one, or none."""
    port = _number(told)
    return port if port and port < 1 << 16 else None


def _number(told: Any) -> int | None:
    """Of a label, which an image may have, too; None: it is none, or so large that Python does not read it."""
    return int(told) if isinstance(told, str) and _NUMBER.fullmatch(told) else None


def parse_helper(inspected: Mapping[str, Any]) -> Helper | None:
    """A guard, or what holds a network; None: it is neither."""
    target = (inspected["Config"].get("Labels") or {}).get(HELPER)
    if target is None:
        return None
    return Helper(inspected["Name"].removeprefix("/"), inspected["State"]["Status"] in ("running", "paused"), target)


def _complaint(log: Sequence[Mapping[str, Any]]) -> str:
    """What the last check said; empty: none has failed.

    One that did not end in time has not, for a busy machine is enough for that. Of a container that was paused an
    engine says that it is unhealthy, whatever its checks said.
    """
    if not log or log[-1].get("ExitCode", 0) <= 0:
        return ""
    return last_line(str(log[-1].get("Output", ""))) or "its health check fails"


def carried_over(new: ContainerState, old: ContainerState | None) -> ContainerState:
    """What one look knows that the next cannot find out again."""
    if old is None:
        return new
    return replace(
        new,
        ready=new.ready or old.ready,
        host_port=new.host_port or old.host_port,
        last_line=new.last_line or old.last_line,
    )


def observation(
    seen: ContainerState,
    options: DockerOptions,
    usage: Usage | None = None,
    exceeds: str = "",
    *,
    cut_off: bool = False,
    reports: tuple[ServiceReport, ...] = (),
    step_s: float | None = None,
) -> Observation:
    """What the contract calls it; ``exceeds``: what it wrote too much of; ``cut_off``: its network is held no more."""
    if seen.ended:
        return Observation(
            seen.attempt,
            Phase.EXITED,
            exit_status=exit_status(seen.exit_code),
            last_line=seen.last_line,
            detail=_how_it_ended(seen),
            out_of_memory=bool(_how_it_ended(seen)),
            reports=reports,
        )
    if seen.runs and seen.ready and seen.host_port is not None:
        used = asdict(usage) if usage is not None else {}
        where = options.advertised, seen.host_port
        ill = "the container that held its network has ended" if cut_off else seen.ill
        told: dict[str, Any] = {"detail": ill, "exceeds": exceeds, "reports": reports, "step_s": step_s}
        return Observation(seen.attempt, Phase.RUNNING, where[0], where[1], **told, **used)
    return Observation(seen.attempt, Phase.STARTING, exceeds=exceeds, reports=reports)


def _how_it_ended(seen: ContainerState) -> str:
    if seen.out_of_memory and seen.exit_code:
        return out_of_memory(seen.limits.memory >> 20)
    return ""
