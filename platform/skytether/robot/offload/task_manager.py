"""Local or offloaded, and to which site (Mello, thesis, section 5.1: Task Manager). Pure: time is an argument.

"The offloading decision weighs the costs associated with processing and transmission to conclude whether to conduct
processing tasks locally or at the cloud." Here the costs are numbers without a unit, about 1 for the worst that the
service bears, and every decision says what they were.

A site costs

    delay      w_delay     * (round trip + 2 * jitter) / max_rtt
    loss       w_loss      * loss / max_loss
    energy     w_energy    * scarcity * radio
    processor  w_processor * (load + cpu / cores), of a site of tier ``robot`` only: it is this machine

and the robot's own controller costs

    service    w_service: what it is worth to have the service instead of the fallback
    processor  w_processor * (load + local_cpu / cores)
    energy     w_energy * scarcity * (load + local_cpu / cores)

with ``max_rtt`` and ``max_loss`` of the service's manifest (`REFERENCE_RTT_S`, `REFERENCE_LOSS` where it states none),
``cpu`` of its manifest, the load of all the robot's processors (0 to 1), and scarcity = 1 - charge of the battery; 0 on
mains, or where no battery is known. A site that was not measured costs what the service just bears. Ruled out is what
cannot be: a site that does not answer, of another tier, or worse than the manifest allows; the robot itself when its
fallback does not drive or its processors would be more than full.

The cheapest wins. Hysteresis: a choice that stands is left for another only if that has been cheaper by ``margin``
without a break for ``hold_s``; if it is ruled out itself, after ``bad_s``. So the choice never changes more often than
that, whatever the network does.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from math import inf, isfinite, nan
from statistics import median

from skytether.api.manifest import Needs, Tier
from skytether.api.rest import Measurement
from skytether.control.numbers import check_positive

REFERENCE_RTT_S = 0.5
"""For services that state no ``max_rtt_ms``."""
REFERENCE_LOSS = 0.1
"""For services that state no ``max_loss``."""
WINDOW = 20
"""Probes of a site that count: the newest."""
LEAST = 3
"""Probes before a site counts as measured."""
OWN_CONTROLLER = "own controller"
"""What the robot's own controller is called beside the sites, of which one may well be ``local``."""


class Mode(StrEnum):
    """Who decides."""

    AUTO = "auto"
    """The costs."""
    OFFLOAD = "offload"
    """Nobody: the service is asked for, always; the costs choose the site."""
    LOCAL = "local"
    """Nobody: the robot's own controller drives, always."""


@dataclass(frozen=True, slots=True)
class Policy:
    """The weights of the cost model, and the hysteresis.

    Attributes:
        mode: Who decides.
        delay: w_delay.
        loss: w_loss.
        energy: w_energy.
        processor: w_processor.
        service: w_service.
        radio: Share of the battery's drain that transmission is, beside computing with all processors.
        local_cpu: Processors that the robot's own controller needs.
        margin: A standing choice is left only for one that costs less by this.
        hold_s: And has done so for this long [s].
        bad_s: A standing choice that is ruled out is left after this long [s].
    """

    mode: Mode = Mode.AUTO
    delay: float = 1.0
    loss: float = 1.0
    energy: float = 0.5
    processor: float = 0.5
    service: float = 2.0
    radio: float = 0.3
    local_cpu: float = 0.1
    margin: float = 0.2
    hold_s: float = 10.0
    bad_s: float = 3.0

    def __post_init__(self) -> None:
        """Refuse weights that turn costs round.

        Raises:
            ValueError: A field is negative or not finite; the text names it.
        """
        check_positive(self, "task", (name for name in self.__slots__ if name != "mode"), zero=True)


@dataclass(frozen=True, slots=True)
class PathQuality:
    """What was measured towards one site; NaN where nothing was.

    Attributes:
        rtt: Median round trip [s].
        jitter: How much longer than the median a slow one takes (90th percentile) [s].
        loss: Share of probes without an answer.
    """

    rtt: float = nan
    jitter: float = nan
    loss: float = nan

    def measurement(self, *, preferred: bool) -> Measurement:
        """As the orchestrator is told."""
        return Measurement(
            rtt_ms=round(self.rtt * 1000, 3) if isfinite(self.rtt) else None,
            jitter_ms=round(self.jitter * 1000, 3) if isfinite(self.jitter) else None,
            loss=round(self.loss, 4) if isfinite(self.loss) else None,
            preferred=preferred,
        )


class Window:
    """The newest probes of one site."""

    def __init__(self) -> None:
        """Nothing is known."""
        self._probes: deque[float] = deque(maxlen=WINDOW)

    def add(self, rtt: float | None) -> None:
        """One probe: its round trip [s], or None if no answer came."""
        self._probes.append(nan if rtt is None else rtt)

    def quality(self) -> PathQuality:
        """Over the window."""
        if len(self._probes) < LEAST:
            return PathQuality()
        answered = sorted(rtt for rtt in self._probes if isfinite(rtt))
        loss = 1 - len(answered) / len(self._probes)
        if not answered:
            return PathQuality(loss=loss)
        middle = median(answered)
        slow = answered[min(len(answered) - 1, round(0.9 * len(answered)))]
        return PathQuality(middle, slow - middle, loss)


@dataclass(frozen=True, slots=True)
class SiteView:
    """A site as the robot sees it."""

    name: str
    tier: Tier
    quality: PathQuality = PathQuality()
    unreachable: str = ""
    """Why the orchestrator says that it cannot be used; empty: it can."""


@dataclass(frozen=True, slots=True)
class RobotView:
    """The robot itself.

    Attributes:
        load: Share of its processors that is busy, 0 to 1; NaN: not known.
        cores: How many it has.
        battery: Charge, 0 to 1; None: no battery is known.
        plugged: It is on mains.
        drives: Whether its own controller drives, or only stops.
    """

    load: float = nan
    cores: int = 1
    battery: float | None = None
    plugged: bool = False
    drives: bool = True


@dataclass(frozen=True, slots=True)
class Option:
    """One thing that could be done, what it costs, or why it cannot be."""

    site: str | None
    """None: the robot's own controller."""
    parts: Mapping[str, float] = field(default_factory=dict)
    refused: str = ""

    @property
    def cost(self) -> float:
        """The sum."""
        return inf if self.refused else sum(self.parts.values())

    @property
    def name(self) -> str:
        """For people; no site can be called like the robot's own controller."""
        return self.site or OWN_CONTROLLER

    def describe(self) -> str:
        """Cost and parts, or why not."""
        if self.refused:
            return f"{self.name}: {self.refused}"
        parts = ", ".join(f"{name} {value:.2f}" for name, value in self.parts.items())
        return f"{self.name} {self.cost:.2f} ({parts})"


@dataclass(frozen=True, slots=True)
class OffloadDecision:
    """What to do.

    Attributes:
        offload: Ask for the service; False: the robot's own controller drives.
        site: Which site is asked for; None: any, the orchestrator chooses.
        why: One line, with the costs behind it.
        since: When it was decided [monotonic s].
        options: All that were weighed at the last look, cheapest first.
        challenger: What would be chosen now, were it not for hysteresis; with when that began.
    """

    offload: bool
    site: str | None
    why: str
    since: float
    options: tuple[Option, ...] = ()
    challenger: tuple[Option, float] | None = None


def start(policy: Policy, now: float) -> OffloadDecision:
    """Before anything is known: a robot does not wait for measurements to ask."""
    if policy.mode is Mode.LOCAL:
        return OffloadDecision(False, None, "local: the configuration says mode local", now)
    return OffloadDecision(True, None, "offload: nothing is measured yet, the orchestrator chooses the site", now)


def decide(
    policy: Policy, before: OffloadDecision, needs: Needs, sites: Sequence[SiteView], robot: RobotView, now: float
) -> OffloadDecision:
    """Look again.

    Args:
        policy: Weights and hysteresis.
        before: The decision that stands; its ``site`` is where the instance runs, if it is known.
        needs: The service's.
        sites: All that the orchestrator has.
        robot: The robot.
        now: Monotonic seconds.

    Returns:
        The decision that stands from now on; ``since`` is ``now`` if it is another one.
    """
    options = tuple(sorted(weigh(policy, needs, sites, robot), key=lambda option: option.cost))
    best = options[0]
    here = next((o for o in options if o.site == before.site and (o.site is not None) == before.offload), None)
    standing = OffloadDecision(before.offload, before.site, before.why, before.since, options)
    if policy.mode is Mode.LOCAL or best.refused:  # with nowhere to go one stays, and goes on asking
        return standing
    if here is None:
        # Offloaded to wherever the orchestrator liked best. Sites that nobody measured are no reason to choose.
        known = any(isfinite(site.quality.rtt) for site in sites)
        return _choose(best, options, "", now) if known else standing
    if best is here:
        return standing
    began = before.challenger[1] if before.challenger and before.challenger[0].site == best.site else now
    began = min(began, now)
    cheaper = here.cost - best.cost
    if here.refused:
        due, why = policy.bad_s, here.describe()
    elif cheaper > policy.margin:
        due, why = policy.hold_s, f"against {here.describe()}"
    else:
        return standing
    if now - began < due:
        return OffloadDecision(before.offload, before.site, before.why, before.since, options, (best, began))
    return _choose(best, options, why, now)


def weigh(policy: Policy, needs: Needs, sites: Sequence[SiteView], robot: RobotView) -> list[Option]:
    """Every option with its costs."""
    options = [_site(policy, needs, site, robot) for site in sites]
    if policy.mode is not Mode.OFFLOAD:
        options.append(_local(policy, robot))
    return options or [Option(None, refused="no site is known, and mode is offload")]


def _choose(option: Option, options: tuple[Option, ...], why: str, now: float) -> OffloadDecision:
    verb = "local" if option.site is None else "offload"
    others = "; ".join(o.describe() for o in options if o is not option)
    line = f"{verb}: {option.describe()}"
    for more in (why or others,):
        line += f"; {more}" if more else ""
    return OffloadDecision(option.site is not None, option.site, line, now, options)


def _site(policy: Policy, needs: Needs, site: SiteView, robot: RobotView) -> Option:
    refused = _why_not(needs, site, robot)
    if refused:
        return Option(site.name, refused=refused)
    measured = site.quality
    rtt = 1.0
    if isfinite(measured.rtt):
        most = REFERENCE_RTT_S if needs.max_rtt_ms is None else needs.max_rtt_ms / 1000
        rtt = (measured.rtt + 2 * max(0.0, measured.jitter)) / most
    loss = 0.0
    if isfinite(measured.loss):
        loss = measured.loss / max(REFERENCE_LOSS if needs.max_loss is None else needs.max_loss, 1e-6)
    parts = {"delay": policy.delay * rtt, "loss": policy.loss * loss}
    parts["energy"] = policy.energy * _scarcity(robot) * policy.radio
    if site.tier == "robot":
        parts["processor"] = policy.processor * _busy(robot, needs.cpu)
    return Option(site.name, parts)


def _why_not(needs: Needs, site: SiteView, robot: RobotView) -> str:
    measured = site.quality
    if site.tier not in needs.tiers:
        return f"is of tier {site.tier}, needed is {' or '.join(needs.tiers)}"
    if site.unreachable:
        return site.unreachable
    if measured.loss >= 1:
        return "answers no probe"
    if needs.max_rtt_ms is not None and measured.rtt * 1000 > needs.max_rtt_ms:
        return f"round trip {measured.rtt * 1000:.0f} ms, at most {needs.max_rtt_ms:g} ms"
    if needs.max_loss is not None and measured.loss > needs.max_loss:
        return f"loses {measured.loss:.0%}, at most {needs.max_loss:.0%}"
    if site.tier == "robot" and _busy(robot, needs.cpu) > 1:
        return f"the robot's processors are {robot.load:.0%} busy, and it needs {needs.cpu:g} of {robot.cores}"
    return ""


def _local(policy: Policy, robot: RobotView) -> Option:
    busy = _busy(robot, policy.local_cpu)
    if not robot.drives:
        return Option(None, refused="the fallback only stops")
    if busy > 1:
        return Option(None, refused=f"the robot's processors are {robot.load:.0%} busy")
    parts = {"service": policy.service, "processor": policy.processor * busy}
    parts["energy"] = policy.energy * _scarcity(robot) * busy
    return Option(None, parts)


def _busy(robot: RobotView, cpu: float) -> float:
    return (robot.load if isfinite(robot.load) else 0.0) + cpu / max(robot.cores, 1)


def _scarcity(robot: RobotView) -> float:
    if robot.battery is None or robot.plugged or not isfinite(robot.battery):
        return 0.0
    return 1 - min(max(robot.battery, 0.0), 1.0)
