"""What a service promised and what the link gives: whether the service may drive (Mello, thesis, section 3.3).

The thesis's Service Manager "is also responsible for monitoring the status of the communication and triggering the use
of a local version of the admittance controller in case of poor QoS". Here are its numbers: how much may be lost or late
on either way, and a sentence for each decision; `accrual` learns how long the service may be silent. Who drives is
chosen by `arbiter` from these, tick by tick; the velocity stays within reach of the one before in `supervisor`, whoever
drives. Pure: time is an argument.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite

from skytether.api.manifest import Needs, TopicSpec
from skytether.wire.stats import SessionStats

from ..session.link_quality import LinkMonitor, Quality
from .arbiter import LinkRequirements, LinkState, Reason
from .failure_detector import LEAST_PERIODS

MOST_LATE = 0.5
"""Share of a topic's messages that may miss their lifespan where the manifest states no ``max_loss``."""
_OVERRATE = 3.0
"""A topic that comes more than this many times as often as its manifest says is named."""


@dataclass(frozen=True, slots=True)
class Terms:
    """What a session is held to.

    Attributes:
        max_rtt_s: Round trip [s]; None: any.
        max_loss: Share of messages lost; None: any but all.
        max_late: Share of messages that miss their lifespan, on any topic.
        period_s: Between commands, as the manifest says [s]; None: it does not say.
    """

    max_rtt_s: float | None = None
    max_loss: float | None = None
    max_late: float = MOST_LATE
    period_s: float | None = None


def terms(needs: Needs, topics: Sequence[TopicSpec], command_topic: str) -> Terms:
    """Read them from what the manifest needs, and from its row of the command topic."""
    period = next((t.period_ms for t in topics if (t.name, t.direction) == (command_topic, "out")), None)
    return Terms(
        max_rtt_s=None if needs.max_rtt_ms is None else needs.max_rtt_ms / 1000,
        max_loss=needs.max_loss,
        max_late=MOST_LATE if needs.max_loss is None else needs.max_loss,
        period_s=None if period is None else period / 1000,
    )


def tighten(own: LinkRequirements, terms: Terms) -> LinkRequirements:
    """What the link must be like: the robot's own needs, and the service's where they are stricter.

    The terms come from the orchestrator, and whatever it answers widens nothing. A number that is none is no need.
    """
    return replace(
        own,
        max_rtt_s=_least(own.max_rtt_s, terms.max_rtt_s),
        max_loss=_least(own.max_loss, terms.max_loss),
        max_late=_least(own.max_late, terms.max_late) or 0.0,
    )


def _least(*given: float | None) -> float | None:
    return min((number for number in given if number is not None and isfinite(number)), default=None)


class ServiceManager:
    """Watches one session against its terms.

    Args:
        terms: The session's.
        command_topic: What drives the robot.
        silence_s: How long one command may act at most, by the robot's own limits [s].
    """

    def __init__(self, terms: Terms, command_topic: str, silence_s: float) -> None:
        self.terms = terms
        self.quality = Quality()
        self._monitor = LinkMonitor()
        self._command_topic = command_topic
        self._silence_s = silence_s
        self._second: tuple[float, int] | None = None
        self._rate = 0.0

    def watch(self, stats: SessionStats, now: float) -> Quality:
        """Look at the bridge's counters; meant for several calls a second."""
        self.quality = self._monitor.sample(stats, now)
        count = sum(t.delivered for t in stats.topics if (t.topic, t.direction) == (self._command_topic, "out"))
        if self._second is None or now < self._second[0] or count < self._second[1]:
            self._second = (now, count)
        elif now - self._second[0] >= 1.0:
            self._rate = (count - self._second[1]) / (now - self._second[0])
            self._second = (now, count)
        return self.quality

    def troubles(self) -> list[tuple[str, str]]:
        """What is odd about the service, apart from the link: kind and sentence of each."""
        found = []
        period = self.terms.period_s
        if period is not None and self._rate > _OVERRATE / period:
            found.append(
                (
                    "overrate",
                    f"the service sends {self._command_topic} {self._rate:.0f} times a second, its manifest says "
                    f"{1 / period:.0f}: the newest is followed; mend the service, or period_ms in its manifest",
                )
            )
        if period is not None and LEAST_PERIODS * period > self._silence_s:
            found.append(
                (
                    "slow",
                    f"the service sends {self._command_topic} every {period * 1000:.0f} ms, and the robot follows one "
                    f"for {self._silence_s * 1000:.0f} ms at most: raise limits.max_gap_s to "
                    f"{LEAST_PERIODS * period:.2g} or more, or use a faster service",
                )
            )
        return found


def explain(reason: Reason, needs: LinkRequirements, link: LinkState, quality: Quality, now: float) -> str:
    """One line on why who drives has changed, with the number asked for and the number found."""
    match reason:
        case Reason.NO_COMMAND:
            limit = f"{needs.command_timeout_s * 1000:.0f} ms at most"
            if link.command_at is None:
                return f"no command yet, {limit}"
            return f"no command for {max(0.0, now - link.command_at) * 1000:.0f} ms, {limit}"
        case Reason.DISCONNECTED:
            return "the bridge has no session"
        case Reason.RTT:
            return f"round trip {link.rtt * 1000:.0f} ms, {(needs.max_rtt_s or inf) * 1000:.0f} ms at most"
        case Reason.LOSS:
            bears = 1.0 if needs.max_loss is None else needs.max_loss
            return f"{link.loss:.0%} of {quality.lossy_topic or 'a topic'} lost, {bears:.0%} at most"
        case Reason.LATE:
            return f"{link.late:.0%} of {quality.late_topic or 'a topic'} too late, {needs.max_late:.0%} at most"
        case Reason.CLOCK:
            known = f"known to {link.clock_error * 1000:.0f} ms" if link.clock_error < inf else "not known"
            return f"the service's clock is {known}, needed is {needs.max_clock_error_s * 1000:.0f} ms"
        case Reason.NEUTRAL:
            return "the service wanted no standstill since the robot was reset"
        case Reason.RECOVERED:
            return f"all has been well for {needs.good_s:g} s"
        case Reason.START:
            return "no command has come yet"
