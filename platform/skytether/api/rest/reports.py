"""What a robot tells with each renewal of its lease."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, FailFast, Field

from skytether.api.manifest import Strict

from .instances import Measurements


def _between(least: float, most: float) -> BeforeValidator:
    """A number outside is taken as not measured: a broken sensor is not to cost the robot its lease."""

    def plausible(value: object) -> object:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        return value if not number or least <= value <= most else None  # type: ignore[operator]

    return BeforeValidator(plausible)


_Share = Annotated[float | None, _between(0, 1)]
_Duration = Annotated[float | None, _between(0, 3600)]
_Delay = Annotated[float | None, _between(-10, 3600)]
"""One way; as wrong as the clocks of both ends are, and so perhaps negative."""
MOST_COUNTED = 10**15
"""A counter's largest value: in bytes 4 MB/s for eight years. Sums of many such are exact in a double."""
MOST_TOPICS = 1024
"""In a report. Beside those of a service there is room for some of the one before it."""
_Count = Annotated[int, Field(ge=0, le=MOST_COUNTED)]
_Counts = Annotated[dict[Annotated[str, Field(max_length=64)], _Count], Field(max_length=64)]
"""By reasons, of which there are few."""


class TopicReport(Strict):
    """One topic's quality as the robot knows it. Counters only go up while the report's ``life`` is the same."""

    topic: Annotated[str, Field(max_length=255)]
    direction: Literal["in", "out"]
    priority: Annotated[int, Field(ge=0, le=127)]
    refused: _Count = 0
    """Published while there was no session, or the service had no such topic; of topics that the robot sends."""
    offered: _Count = 0
    """All others that were published. What of them was not sent was too old or too many, or waits."""
    sent: _Count = 0
    delivered: _Count = 0
    lost: _Count = 0
    """Those that came late after all included: when nothing is under way any more,
    ``sent == delivered + superseded + lost - late + unknown``."""
    late: _Count = 0
    unknown: _Count = 0
    """Sent to a service before it was restarted, which had not said what became of them, or under way when their
    session ended."""
    expired: _Count = 0
    replaced: _Count = 0
    superseded: _Count = 0
    duplicate: _Count = 0
    bytes_sent: _Count = 0
    delay_p50_s: _Delay = None
    """Delays and jitter are those of the present session."""
    delay_p99_s: _Delay = None
    jitter_s: _Duration = None


class GateReport(Strict):
    """The gate before the robot's wheels, as the agent beside it sees it."""

    answers: bool = False
    stopped: Annotated[str, Field(max_length=200)] = ""
    """Why the robot stands until a person beside it resets it; empty: it does not."""
    hand: Annotated[str, Field(max_length=32)] = ""
    """Who drives, as the gate says: ``agent``, ``joystick``, another source, or ``nobody``."""
    zone: Annotated[str, Field(max_length=32)] = ""
    """What lies ahead: ``free``, ``slow``, ``stop`` or ``unknown``."""
    troubles: Annotated[int, Field(ge=0, le=10_000)] = 0
    """Sentences that the gate has to say about what is wrong now."""


class Report(Strict):
    """What the robot tells the orchestrator with each renewal; it feeds /metrics."""

    life: Annotated[str, Field(max_length=64)] = ""
    """Which counting it is of: another one begins at zero, and adds to what was counted before. Made up anew at each
    start of the robot's program; under the same one counters go on over all its sessions with a service."""
    rtt_s: _Duration = None
    # Up to the first fault only: 180,000 of them, in a body that a robot may send, took a second to find and tell.
    topics: Annotated[tuple[TopicReport, ...], Field(max_length=MOST_TOPICS), FailFast()] = ()
    control_source: Annotated[str, Field(max_length=16)] | None = None
    """Who drives: ``cloud``, ``fallback`` or ``stop``."""
    fallback_transitions: _Counts = {}
    """Counted by bounded reason."""
    objections: _Counts = {}
    """What the velocity supervisor found wrong with commands, counted by bounded kind."""
    load: _Share = None
    """Share of the robot's processors that is busy."""
    battery: _Share = None
    """Charge, 0 to 1."""
    overruns: _Count | None = None
    """Ticks of the control loop that came more than a period late."""
    gate: GateReport | None = None
    """None: the robot's wheels are behind no gate."""


class Renew(Strict):
    """Keep the lease; optionally report."""

    measurements: Measurements = {}
    """What was measured since, instead of what was told before."""

    lease_s: Annotated[float, Field(ge=1, le=86_400)] | None = None
    report: Report | None = None
