"""Source choice: cloud or the robot's own controller, from the quality of the link. Pure: time is an argument.

(Mello, thesis, section 3.3: the Service Manager monitors the communication and triggers the robot's own controller.)

Two kinds of trouble. Without a valid command or a session the robot is on its own at once. A round trip, a loss, a
lateness or a clock that is worse than the service's manifest allows must last before it counts. The way back is the
same for all: the link must have been good without a break for ``good_s``, so that the cloud never takes over more often
than that. After a reset the cloud does not take over, however good the link is, before it wanted a standstill.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from math import inf, isfinite, nan

from skytether.control.numbers import check_positive

from .command import Source
from .supervisor import DEFAULT_MAX_RTT_S


class Reason(StrEnum):
    """Why the source is what it is; bounded, for counters."""

    START = "start"
    """No valid command has come yet."""
    NO_COMMAND = "no_command"
    """The last valid command arrived too long ago."""
    DISCONNECTED = "disconnected"
    """The bridge has no session."""
    RTT = "rtt"
    """The round trip is longer than the service needs."""
    LOSS = "loss"
    """More messages are lost than the service bears."""
    LATE = "late"
    """More messages of a topic are too old before they are through than the service bears."""
    CLOCK = "clock"
    """The peer's clock is not known well enough to judge the age of commands."""
    NEUTRAL = "neutral"
    """The robot was reset, and the service has not wanted a standstill since."""
    RECOVERED = "recovered"
    """The link has been good for long enough."""


@dataclass(frozen=True, slots=True)
class LinkRequirements:
    """What the link must be like, and how patient the arbiter is. The defaults are the robot's own.

    What a service needs only tightens them (`skytether.robot.control.service_manager.tighten`).

    Attributes:
        max_rtt_s: Round trip [s]; None: any. The oldest information that may drive is by
            `VelocityLimits.max_gap_s` older.
        max_loss: Share of messages; None: any but all.
        max_late: Share of a topic's messages that may miss their lifespan.
        max_clock_error_s: Largest bound of the clock offset's error [s].
        command_timeout_s: Without a valid command for this long the robot is on its own [s]; what is learned of the
            commands takes its place (`accrual`).
        bad_s: How long round trip, loss, lateness or clock must be bad in one piece [s].
        good_s: How long everything must be good in one piece before the cloud drives (again) [s].
        local: Who drives when the cloud does not.
    """

    max_rtt_s: float | None = DEFAULT_MAX_RTT_S
    max_loss: float | None = 0.5
    max_late: float = 0.5
    max_clock_error_s: float = 0.5
    command_timeout_s: float = 0.15
    bad_s: float = 0.5
    good_s: float = 1.0
    local: Source = Source.FALLBACK

    def __post_init__(self) -> None:
        """Refuse a cloud as the local source, and times that are none.

        Raises:
            ValueError: The text names the field.
        """
        if self.local is Source.CLOUD:
            raise ValueError("needs: local must be 'fallback' or 'stop'")
        check_positive(self, "needs", ("max_clock_error_s", "command_timeout_s", "bad_s", "good_s"))


@dataclass(frozen=True, slots=True)
class LinkState:
    """What is known of the link now; NaN where nothing was measured.

    Attributes:
        connected: The bridge has a session.
        command_at: When the last valid command arrived [monotonic s]; None: none yet.
        rtt: Round trip [s].
        loss: Share of messages lost over a recent window.
        late: Share of messages that missed their lifespan over a recent window.
        clock_error: Bound of the clock offset's error [s].
        owes: The service must have wanted a standstill before it takes over (`neutral`).
    """

    connected: bool = False
    command_at: float | None = None
    rtt: float = nan
    loss: float = nan
    late: float = nan
    clock_error: float = inf
    owes: bool = False


@dataclass(frozen=True, slots=True)
class ArbiterDecision:
    """Who drives, why, since when.

    Attributes:
        source: Who drives.
        reason: Of the last change.
        since: When it was [monotonic s].
        good_since: Start of the good spell that lasts until now; None: it is not good.
        bad_since: Start of the bad spell that lasts until now; None: it is not bad.
    """

    source: Source
    reason: Reason
    since: float
    good_since: float | None = None
    bad_since: float | None = None


def start(needs: LinkRequirements, now: float) -> ArbiterDecision:
    """Before the first command of the cloud the robot is on its own."""
    return ArbiterDecision(needs.local, Reason.START, now)


def choose(needs: LinkRequirements, choice: ArbiterDecision, link: LinkState, now: float) -> ArbiterDecision:
    """Decide who drives. The result has another ``source`` only when it changed; then ``reason`` says why."""
    trouble = _trouble(needs, link, now)
    if trouble is None and link.owes:
        owing = choice if choice.source is needs.local else ArbiterDecision(needs.local, Reason.NEUTRAL, now)
        return replace(owing, good_since=_begin(choice.good_since, now), bad_since=None)
    if trouble is None:
        good_since = _begin(choice.good_since, now)
        if choice.source is Source.CLOUD:
            return replace(choice, good_since=good_since, bad_since=None)
        if now - good_since >= needs.good_s:
            return ArbiterDecision(Source.CLOUD, Reason.RECOVERED, now, good_since=good_since)
        return replace(choice, source=needs.local, good_since=good_since, bad_since=None)
    bad_since = _begin(choice.bad_since, now)
    if choice.source is not Source.CLOUD:
        return replace(choice, source=needs.local, good_since=None, bad_since=bad_since)
    at_once = trouble in (Reason.NO_COMMAND, Reason.DISCONNECTED)
    if at_once or now - bad_since >= needs.bad_s:
        return ArbiterDecision(needs.local, trouble, now, bad_since=bad_since)
    return replace(choice, good_since=None, bad_since=bad_since)


def _begin(since: float | None, now: float) -> float:
    """Start of a spell; a clock that jumped back starts it anew."""
    return since if since is not None and since <= now else now


def _trouble(needs: LinkRequirements, link: LinkState, now: float) -> Reason | None:
    if not link.connected:
        return Reason.DISCONNECTED
    if link.command_at is None or not isfinite(now) or not now - link.command_at <= needs.command_timeout_s:
        return Reason.NO_COMMAND
    if needs.max_rtt_s is not None and link.rtt > needs.max_rtt_s:
        return Reason.RTT
    if link.loss >= 1 or (needs.max_loss is not None and link.loss > needs.max_loss):
        return Reason.LOSS
    if link.late > needs.max_late:
        return Reason.LATE
    if not link.clock_error <= needs.max_clock_error_s:
        return Reason.CLOCK
    return None
