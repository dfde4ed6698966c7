"""What an agent says of itself: a snapshot for those who look, a report for the orchestrator. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite, nan

from skytether.api import rest
from skytether.ros.followed import Followed
from skytether.wire.stats import SessionStats

from ..control.control_status import ControlStatus
from ..graphs.wheels_watch import NOBODY, Others
from ..offload.task_manager import OffloadDecision
from ..session.counter_totals import COUNTERS, CounterTotals


@dataclass(frozen=True, slots=True)
class AgentStatus:
    """A snapshot of everything. Times are monotonic seconds.

    Attributes:
        driver: What the control loop knows.
        instance: The last that was heard of it.
        trouble: What stands in the way of a session, in one sentence; empty while all is well.
        asked_at: When the service was first asked for.
        connected: The bridge has a session.
        session: The bridge's counters.
        rtt: Round trip [s].
        loss: Share of messages lost over the last seconds.
        overruns: Ticks that started more than one period late.
        log_lines_dropped: Lines of the log that nobody read in time.
        late: Share of messages that missed their lifespan over the last seconds.
        decision: The task manager's; None: there is none.
        load: Share of the robot's processors that is busy; NaN: not known.
        battery: Charge, 0 to 1; None: not known.
        others: Who else publishes what the wheels listen to.
        gate: What the gate says of itself; None: there is none.
        topics: How the topics stand in the robot's graph; empty: it has none.
        rates: Messages a second, by topic and direction.
    """

    driver: ControlStatus
    instance: rest.Instance | None
    trouble: str
    asked_at: float | None
    connected: bool
    session: SessionStats | None
    rtt: float
    loss: float
    overruns: int
    log_lines_dropped: int = 0
    late: float = nan
    decision: OffloadDecision | None = None
    load: float = nan
    battery: float | None = None
    others: Others = NOBODY
    gate: rest.GateReport | None = None
    topics: tuple[Followed, ...] = ()
    rates: Mapping[tuple[str, str], float] = field(default_factory=dict)


def report(
    driver: ControlStatus | None,
    totals: CounterTotals,
    stats: SessionStats | None,
    rtt: float,
    *,
    load: float = nan,
    battery: float | None = None,
    overruns: int | None = None,
    gate: rest.GateReport | None = None,
) -> rest.Report:
    """Say for the orchestrator's metrics what bridge and control loop counted.

    Args:
        driver: What the control loop knows; None: there is none.
        totals: What all sessions counted.
        stats: The present session's, for delays.
        rtt: Round trip [s]; NaN: not known.
        load: Share of the robot's processors that is busy; NaN: not known.
        battery: Charge, 0 to 1.
        overruns: Of the control loop.
        gate: What the gate says of itself; None: there is none.
    """
    present = {(topic.topic, topic.direction): topic for topic in (stats.topics if stats else ())}
    # Those of the present session before others: of services before it there may be any number.
    sums = sorted(totals.sums().items(), key=lambda one: one[0] not in present)[: rest.MOST_TOPICS]
    return rest.Report(
        life=totals.life,
        rtt_s=_known(rtt),
        topics=tuple(
            rest.TopicReport(
                topic=key[0],
                direction="in" if key[1] == "in" else "out",
                priority=priority,
                # A service may claim any number: one that the orchestrator refuses must not cost the robot its lease.
                **{name: min(max(counts[name], 0), rest.MOST_COUNTED) for name in COUNTERS},
                delay_p50_s=_known(present[key].delay_p50) if key in present else None,
                delay_p99_s=_known(present[key].delay_p99) if key in present else None,
                jitter_s=_known(present[key].jitter) if key in present else None,
            )
            for key, (priority, counts) in sums
        ),
        control_source=driver.source if driver else None,
        fallback_transitions=dict(driver.transition_counts) if driver else {},
        objections=dict(driver.objections) if driver else {},
        load=_known(load),
        battery=battery,
        overruns=overruns,
        gate=gate,
    )


def _known(value: float) -> float | None:
    return value if isfinite(value) else None
