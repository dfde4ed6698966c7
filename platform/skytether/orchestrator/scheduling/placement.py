"""Where an instance should run: pure.

First what rules a site out, each refusal with the number asked for and the one found; then a score for what is left, in
milliseconds: the delay of control to be expected there, and what money and crowding are worth.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from skytether.api.manifest import Needs, Tier
from skytether.api.rest import Measurement, Refusal, Score

from ..config.settings import Weights
from ..domain.records import Record
from ..runtimes.base import Capacity, RuntimeFailure

NOTHING = Capacity(0.0, 0)
UNSTARTED = "start"
"""Reason of a refusal by a site that was tried: it stays with the instance while another one fits. Where others were
tried, it is ``unfit``, which ends by itself."""
DRAINING = "is being deleted, and takes no more instances"
_TIER_ORDER: Mapping[Tier, int] = {"robot": 0, "edge": 1, "cloud": 2}
"""Nearer first, where nothing was measured."""
_MOST = Capacity(1e6, 1 << 40, 1 << 20)
"""Of one site, clusters among them: more is no number of its machines."""
_FULLEST = 0.95
"""Utilisation beyond which queueing is not reckoned as longer: the formula's pole is no prediction."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A site as placement sees it."""

    name: str
    tier: Tier
    cannot_run: str | None = None
    """Why its runtime cannot run this service at all; None: it can."""
    draining: bool = False
    """It is to be deleted: no instance comes to it any more, however it comes."""
    unstarted: str | None = None
    """Why this very instance could not be started there; None: it was not tried, or could."""
    unfit: str | None = None
    """Why no instance of this service is to be started there for a while; None: it may be."""
    unreachable: str | None = None
    """Why it does not answer; None: it does."""
    blocked: str | None = None
    """Why it can start nothing at present, though it answers; None: it can."""
    full: str | None = None
    """Why it takes no more, whatever its room; None: it does."""
    total: Capacity = NOTHING
    used: Capacity = NOTHING
    """What the instances that are there asked for."""
    load: float = 0.0
    """Share of its processors that is busy, whoever makes them so; 0 where it is not known."""
    speed: float = 1.0
    """Of one core, beside the core for which services state ``compute_ms``."""
    cost: float = 0.0
    """Of one instance, in the operator's unit."""
    images: tuple[str, ...] = ("*",)
    """Patterns of the images that may run there."""
    fills: bool = False
    """It is better the fuller it is, so that others like it become idle and can be given back."""


@dataclass(frozen=True, slots=True)
class Prospect:
    """What a group of sites could do for an instance that no site takes."""

    refusal: Refusal
    """Under the group's name: why none of its machines could take it, or what keeps it from being made at once."""
    hopeless: bool
    """None could: waiting for one is no use."""


@dataclass(frozen=True, slots=True)
class PlacementDecision:
    """The best site, or None, and why not the others."""

    site: str | None
    refused: tuple[Refusal, ...]
    hopeless: bool
    """None fits, and none would if it were empty and reachable: waiting is no use."""
    scores: tuple[Score, ...] = ()
    """Of the sites that fit, the best first."""


def believable(capacity: Capacity) -> Capacity:
    """What a site says that it has, as far as that can be: all sites are reckoned with, and shown, together.

    Raises:
        RuntimeFailure: It cannot.
    """
    numbers = ((capacity.cpu, _MOST.cpu), (capacity.memory_mb, _MOST.memory_mb), (capacity.gpu, _MOST.gpu))
    if not all(math.isfinite(value) and 0 <= value <= most for value, most in numbers):
        raise RuntimeFailure("it says that it has what nothing has: processors, memory or GPUs cannot be so many")
    return capacity


def place(
    needs: Needs,
    measured: Mapping[str, Measurement],
    candidates: Sequence[Candidate],
    *,
    image: str | None = None,
    weights: Weights = Weights(),  # noqa: B008 (frozen)
) -> PlacementDecision:
    """Choose a site.

    Of those that fit, one that the robot prefers, then the one with the lowest score; at equal scores the nearest tier,
    then the first by name. A robot that measured nothing towards a site does not rule it out: the site counts with the
    worst that the service bears.
    """
    verdicts = [(site, _refuse(needs, measured.get(site.name, Measurement()), site, image)) for site in candidates]
    fitting = [site for site, verdict in verdicts if verdict is None]
    tiers = {site.name: _TIER_ORDER[site.tier] for site in fitting}
    scores = [score(needs, measured.get(site.name, Measurement()), site, weights) for site in fitting]
    wanted = {name for name, measurement in measured.items() if measurement.preferred}
    scores.sort(key=lambda s: (s.site not in wanted, s.total_ms, tiers[s.site], s.site))
    refused = tuple(verdict[0] for _, verdict in verdicts if verdict)
    hopeless = all(verdict is not None and verdict[1] for _, verdict in verdicts)
    return PlacementDecision(scores[0].site if scores else None, refused, hopeless, tuple(scores))


def score(needs: Needs, measured: Measurement, site: Candidate, weights: Weights) -> Score:
    """What an instance there would cost the robot, part by part, in milliseconds.

    The delay of control is round trip (with its jitter), computing, and waiting for a processor: of a queue with random
    arrivals (M/M/1), the time of service times u / (1 - u) at utilisation u, which is what was promised to instances or
    what is busy, whichever is more, with this instance added.
    """
    if measured.rtt_ms is not None:
        rtt = measured.rtt_ms + (measured.jitter_ms or 0.0)
    else:
        rtt = needs.max_rtt_ms if needs.max_rtt_ms is not None else weights.unmeasured_ms
    compute = needs.compute_ms / site.speed
    cores = max(site.total.cpu, 1e-9)
    promised = (site.used.cpu + needs.cpu) / cores
    busy = min(max(promised, site.load + needs.cpu / cores), _FULLEST)
    crowded = min(promised, 1.0)
    spread = weights.fill_ms * (1.0 - crowded) if site.fills else weights.spread_ms * crowded
    return Score(
        site=site.name,
        rtt_ms=round(rtt, 3),
        measured=measured.rtt_ms is not None,
        compute_ms=round(compute, 3),
        queue_ms=round(compute * busy / (1 - busy), 3),
        cost_ms=round(weights.cost_ms * site.cost, 3),
        spread_ms=round(spread, 3),
    )


def _refuse(needs: Needs, measured: Measurement, site: Candidate, image: str | None) -> tuple[Refusal, bool] | None:
    """Why not, and whether for good; None: it fits. What is for good comes first."""

    def no(reason: str, detail: str, *, for_good: bool = True) -> tuple[Refusal, bool]:
        return Refusal(site=site.name, reason=reason, detail=detail), for_good

    if site.tier not in needs.tiers:
        return no("tier", f"is of tier {site.tier}, needed is {' or '.join(needs.tiers)}")
    if site.cannot_run is not None:
        return no("runtime", site.cannot_run)
    if site.draining:
        return no("draining", DRAINING)
    if site.unstarted is not None:
        return no(UNSTARTED, site.unstarted)
    if image is not None and not any(fnmatchcase(image, pattern) for pattern in site.images):
        return no("image", f"allows images {', '.join(site.images) or '(none)'}, asked for is {image}")
    if needs.architectures and site.total.architecture and site.total.architecture not in needs.architectures:
        wanted = " or ".join(needs.architectures)
        return no("architecture", f"is {site.total.architecture}, needed is {wanted}")
    if needs.max_rtt_ms is not None and measured.rtt_ms is not None and measured.rtt_ms > needs.max_rtt_ms:
        return no("rtt", f"round trip measured {measured.rtt_ms:g} ms, at most {needs.max_rtt_ms:g} ms allowed")
    if needs.max_loss is not None and measured.loss is not None and measured.loss > needs.max_loss:
        return no("loss", f"loss measured {measured.loss:.1%}, at most {needs.max_loss:.1%} allowed")
    if site.unreachable is not None:
        return no("unreachable", site.unreachable, for_good=False)
    if site.blocked is not None:
        return no("blocked", site.blocked, for_good=False)
    if site.unfit is not None:
        return no("unfit", site.unfit, for_good=False)
    if site.full is not None:
        return no("instances", site.full, for_good=False)
    lack = lacks(needs, site.total, site.used)
    return None if lack is None else no(lack[0], lack[1], for_good=lack[2])


def lacks(needs: Needs, total: Capacity, used: Capacity) -> tuple[str, str, bool] | None:
    """What a site has too little of: in one word, in words for people, and whether it has so in all; None: of nothing.

    Args:
        needs: Of one instance.
        total: What the site has.
        used: What others have of it.
    """
    amounts = (
        ("cpu", "cores", needs.cpu, total.cpu, used.cpu),
        ("memory", "MiB of memory", needs.memory_mb, total.memory_mb, used.memory_mb),
        ("gpu", "GPUs", needs.gpu, total.gpu, used.gpu),
    )
    for reason, unit, needed, there, _ in amounts:
        if needed > there:
            return reason, f"needs {needed:g} {unit}, the site has {there:g}", True
    for reason, unit, needed, there, taken in amounts:
        if needed > there - taken + 1e-9:  # cores are fractions; ten times 0.1 must fit into 1
            free = f"{round(max(there - taken, 0.0), 2):g} of {there:g} are free"
            return reason, f"needs {needed:g} {unit}, {free}", False
    return None


def explain_refusals(record: Record, refused: Sequence[Refusal]) -> str:
    """All refusals in one sentence."""
    none = "no other" if record.replaces else "none"
    return "; ".join(f"{r.site}: {r.detail}" for r in refused) or f"there is {none}: add one with `skytether site add`"
