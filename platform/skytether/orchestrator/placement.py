"""Where an instance should run: pure. Each refusal says why, with the number asked for and the one found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from skytether.api.manifest import Needs, Tier
from skytether.api.rest import Measurement, Refusal

from .runtimes.base import Capacity

NOTHING = Capacity(0.0, 0)
_TIER_ORDER: Mapping[Tier, int] = {"robot": 0, "edge": 1, "cloud": 2}
"""Nearer first, where nothing was measured."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A site as placement sees it."""

    name: str
    tier: Tier
    cannot_run: str | None = None
    """Why its runtime cannot run this service at all; None: it can."""
    unreachable: str | None = None
    """Why it does not answer; None: it does."""
    total: Capacity = NOTHING
    used: Capacity = NOTHING
    """What the instances that are there asked for."""


@dataclass(frozen=True, slots=True)
class Decision:
    """The best site, or None, and why not the others."""

    site: str | None
    refused: tuple[Refusal, ...]
    hopeless: bool
    """None fits, and none would if it were empty and reachable: waiting is no use."""


def place(needs: Needs, measured: Mapping[str, Measurement], candidates: Sequence[Candidate]) -> Decision:
    """Choose a site.

    Of those that fit, the one with the lowest measured round trip; then the nearest tier, the most free processor, and
    the first by name. A robot that measured nothing towards a site does not rule it out.
    """
    verdicts = [(site, _refuse(needs, measured.get(site.name, Measurement()), site)) for site in candidates]
    fitting = [site for site, verdict in verdicts if verdict is None]
    best = min(fitting, key=lambda site: _rank(site, measured.get(site.name)), default=None)
    refused = tuple(verdict[0] for _, verdict in verdicts if verdict)
    hopeless = all(verdict is not None and verdict[1] for _, verdict in verdicts)
    return Decision(best.name if best else None, refused, hopeless)


def _rank(site: Candidate, measured: Measurement | None) -> tuple[float, int, float, str]:
    rtt = measured.rtt_ms if measured and measured.rtt_ms is not None else float("inf")
    return rtt, _TIER_ORDER[site.tier], site.used.cpu - site.total.cpu, site.name


def _refuse(needs: Needs, measured: Measurement, site: Candidate) -> tuple[Refusal, bool] | None:
    """Why not, and whether for good; None: it fits. What is for good comes first."""

    def no(reason: str, detail: str, *, for_good: bool = True) -> tuple[Refusal, bool]:
        return Refusal(site=site.name, reason=reason, detail=detail), for_good

    if site.tier not in needs.tiers:
        return no("tier", f"is of tier {site.tier}, needed is {' or '.join(needs.tiers)}")
    if site.cannot_run is not None:
        return no("runtime", site.cannot_run)
    if needs.max_rtt_ms is not None and measured.rtt_ms is not None and measured.rtt_ms > needs.max_rtt_ms:
        return no("rtt", f"round trip measured {measured.rtt_ms:g} ms, at most {needs.max_rtt_ms:g} ms allowed")
    if needs.max_loss is not None and measured.loss is not None and measured.loss > needs.max_loss:
        return no("loss", f"loss measured {measured.loss:.1%}, at most {needs.max_loss:.1%} allowed")
    if site.unreachable is not None:
        return no("unreachable", site.unreachable, for_good=False)
    amounts = (
        ("cpu", "cores", needs.cpu, site.total.cpu, site.used.cpu),
        ("memory", "MiB of memory", needs.memory_mb, site.total.memory_mb, site.used.memory_mb),
        ("gpu", "GPUs", needs.gpu, site.total.gpu, site.used.gpu),
    )
    for reason, unit, needed, total, _ in amounts:
        if needed > total:
            return no(reason, f"needs {needed:g} {unit}, the site has {total:g}")
    for reason, unit, needed, total, used in amounts:
        if needed > total - used + 1e-9:  # cores are fractions; ten times 0.1 must fit into 1
            free = f"{round(max(total - used, 0.0), 2):g} of {total:g} are free"
            return no(reason, f"needs {needed:g} {unit}, {free}", for_good=False)
    return None
