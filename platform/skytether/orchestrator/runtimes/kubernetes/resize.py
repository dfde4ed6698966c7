"""What a pod's container may take, as it is told and changed in place (``pods/resize``, Kubernetes 1.33): pure.

A pod's class of quality of service stays as it began: the API server refuses what would change it. So a pod whose
requests are its limits keeps them equal, and any other one keeps them apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from skytether.api.manifest import ServiceSpec

from ..containers import most_cores, most_memory_mb

Document = Mapping[str, Any]
SUBRESOURCE = "pods/resize"
_ROUNDED = 10
"""Thousandths of cores."""
_UNITS = {"n": 1e-9, "u": 1e-6, "m": 1e-3, "k": 1e3, "M": 1e6, "G": 1e9, "T": 1e12, "P": 1e15, "E": 1e18} | {
    f"{unit}i": 1024.0**power for power, unit in enumerate("KMGTPE", start=1)
}


def quantity(text: str) -> float:
    """Of a resource: ``500m``, ``16Gi``.

    Raises:
        ValueError: It is none.
    """
    for unit in (text[-2:], text[-1:]):
        if unit in _UNITS:
            return float(text[: -len(unit)]) * _UNITS[unit]
    return float(text)


class Resources(NamedTuple):
    """Of one container: what is kept for it, and what it may take."""

    cpu_request: int
    """Thousandths of cores."""
    cpu_limit: int
    memory_request: int
    """MiB."""
    memory_limit: int

    @property
    def guaranteed(self) -> bool:
        """Whether all that it may take is kept for it."""
        return self.cpu_request == self.cpu_limit and self.memory_request == self.memory_limit

    def document(self) -> dict[str, dict[str, str]]:
        """As a pod has it."""
        return {
            "requests": {"cpu": f"{self.cpu_request}m", "memory": f"{self.memory_request}Mi"},
            "limits": {"cpu": f"{self.cpu_limit}m", "memory": f"{self.memory_limit}Mi"},
        }


def resources_of(spec: ServiceSpec) -> Resources:
    """Of a service."""
    needs = spec.needs
    return Resources(_thousandths(needs.cpu), _thousandths(most_cores(spec)), needs.memory_mb, most_memory_mb(spec))


def in_class_of(wanted: Resources, has: Resources) -> Resources:
    """The same, so that the pod stays in its class."""
    if has.guaranteed == wanted.guaranteed:
        return wanted
    if has.guaranteed:
        return wanted._replace(cpu_limit=wanted.cpu_request, memory_limit=wanted.memory_request)
    if wanted.cpu_request > 1:
        return wanted._replace(cpu_request=wanted.cpu_request - 1)
    return wanted._replace(cpu_limit=wanted.cpu_limit + 1)


def pull_resources(document: Document) -> Resources | None:
    """Of a container, out of its description or its status; None: it says nothing of that."""
    requests, limits = document.get("requests") or {}, document.get("limits") or {}
    try:
        cpu, memory = requests["cpu"], requests["memory"]
        most_cpu, most_memory = limits["cpu"], limits["memory"]
        return Resources(
            _thousandths(quantity(str(cpu))),
            _thousandths(quantity(str(most_cpu))),
            int(quantity(str(memory))) >> 20,
            int(quantity(str(most_memory))) >> 20,
        )
    except (KeyError, ValueError):
        return None


def pull_progress(status: Document) -> tuple[bool, str]:
    """Out of a pod's status: whether its node is at it, and why it will not do it (empty: it will)."""
    at_it = status.get("resize") in ("Proposed", "InProgress", "Deferred")  # Kubernetes before 1.33 said it so
    never = "its node has no room for that" if status.get("resize") == "Infeasible" else ""
    for condition in status.get("conditions") or ():
        if condition["status"] != "True":
            continue
        said = str(condition.get("message") or condition.get("reason", ""))
        if condition["type"] == "PodResizeInProgress":
            at_it = True
        elif condition["type"] == "PodResizePending":
            at_it = True
            never = said if condition.get("reason") == "Infeasible" else never
    return at_it, never


def differ(has: Resources | None, wanted: Resources | None) -> bool:
    """Whether a node says that a container has something else, but for how the kernel rounds small shares."""
    if has is None or wanted is None:
        return False
    cpu = max(abs(has.cpu_request - wanted.cpu_request), abs(has.cpu_limit - wanted.cpu_limit))
    return cpu > _ROUNDED or has[2:] != wanted[2:]


def patch(uid: str, wanted: Resources) -> dict[str, Any]:
    """The body of a strategic merge patch of this very pod, to ``SUBRESOURCE``."""
    container = {"name": "service", "resources": wanted.document()}
    return {"metadata": {"uid": uid}, "spec": {"containers": [container]}}


def _thousandths(cores: float) -> int:
    return max(1, round(1000 * cores))
