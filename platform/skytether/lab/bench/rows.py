"""From what both ends noted down to the rows that are printed. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from .traffic import Flow


@dataclass(frozen=True, slots=True)
class Notes:
    """What one end of a transport noted about one measurement. Times are of the machine's monotonic clock.

    Attributes:
        sent: For each flow that this end sends, by its index: when each message was handed over [s], by sequence.
        received: For each flow that this end receives: sequence, time sent and time received [s] of each arrival.
        cpu_s: Processor time that this end's process used between the start and the end of the measurement.
    """

    sent: dict[int, list[float]]
    received: dict[int, list[tuple[int, float, float]]]
    cpu_s: float


@dataclass(frozen=True, slots=True)
class Row:
    """One topic over one transport under one condition.

    Attributes:
        transport: Name of the transport.
        condition: Name of the link, or of the cell of a suite.
        topic: Name of the topic.
        sent: Messages handed to the transport.
        delivered: Of these, messages that arrived before the measurement was over; repeated ones count once.
        delay_p50_ms: From the call that sends to the call that delivers, of delivered messages; None without any.
        delay_p95_ms: Likewise.
        delay_p99_ms: Likewise.
        delay_max_ms: Likewise.
        overhead: Bytes that entered the link in both directions, IP headers included, beyond payload, over payload
            (of all topics together: who encrypts does not show which); less than 0 for a transport that drops messages
            before they get there. None where no emulator counts.
        cpu_s: Processor seconds of both ends, the harness's own making of messages included.
        cpu_robot_s: The robot's share of it.
        cpu_service_s: The service's share of it.
        congestion: TCP's congestion control where TCP is used, else None.
        emulator: ``tun``, ``user`` or ``none``.
        emulator_late_ms: The most that the emulator was late with a packet, its own error in these delays; None
            without one.
        size: Payload in bytes.
        seconds: Length of the measurement.
    """

    transport: str
    condition: str
    topic: str
    sent: int
    delivered: int
    delay_p50_ms: float | None
    delay_p95_ms: float | None
    delay_p99_ms: float | None
    delay_max_ms: float | None
    overhead: float | None
    cpu_s: float
    cpu_robot_s: float
    cpu_service_s: float
    congestion: str | None
    emulator: str
    emulator_late_ms: float | None
    size: int
    seconds: float

    @property
    def lost(self) -> float:
        """Share of messages that did not arrive; 0 when none was sent."""
        return 1 - self.delivered / self.sent if self.sent else 0.0

    def document(self) -> dict[str, object]:
        """For ``--json``."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class Carried:
    """What entered the link, both ways: so many ``bytes`` of IP packets between two moments [s]."""

    start: float
    end: float
    bytes: int


@dataclass(frozen=True, slots=True)
class Run:
    """What all rows of one measurement have in common; the fields mean what they mean in `Row`."""

    transport: str
    condition: str
    congestion: str | None
    emulator: str
    start: float
    seconds: float
    carried: Carried | None
    emulator_late_ms: float | None


def make_rows(run: Run, flows: Sequence[Flow], robot: Notes, service: Notes) -> list[Row]:
    """One row for each flow, of the messages sent in ``run.seconds`` from ``run.start`` on."""
    end = run.start + run.seconds
    delays: list[list[float]] = []
    counts = []
    payload = 0
    for index, flow in enumerate(flows):
        sent = next((n.sent[index] for n in (robot, service) if index in n.sent), [])
        received = next((n.received[index] for n in (robot, service) if index in n.received), [])
        counts.append(sum(run.start <= t < end for t in sent))
        if run.carried is not None:
            payload += flow.size * sum(run.carried.start <= t < run.carried.end for t in sent)
        first: dict[int, float] = {}
        for sequence, sent_at, received_at in received:
            if run.start <= sent_at < end:
                first.setdefault(sequence, received_at - sent_at)
        delays.append(list(first.values()))
    overhead = None
    if (carried := run.carried) and payload:
        overhead = carried.bytes / payload - 1
    rows = []
    for flow, sent_count, delay in zip(flows, counts, delays, strict=True):
        p50, p95, p99, most = percentiles_ms(delay)
        rows.append(
            Row(
                transport=run.transport,
                condition=run.condition,
                topic=flow.name,
                sent=sent_count,
                delivered=len(delay),
                delay_p50_ms=p50,
                delay_p95_ms=p95,
                delay_p99_ms=p99,
                delay_max_ms=most,
                overhead=None if overhead is None else round(overhead, 4),
                cpu_s=round(robot.cpu_s + service.cpu_s, 3),
                cpu_robot_s=round(robot.cpu_s, 3),
                cpu_service_s=round(service.cpu_s, 3),
                congestion=run.congestion,
                emulator=run.emulator,
                emulator_late_ms=run.emulator_late_ms,
                size=flow.size,
                seconds=run.seconds,
            )
        )
    return rows


def percentiles_ms(delays: Iterable[float]) -> tuple[float | None, float | None, float | None, float | None]:
    """50th, 95th and 99th percentile (a measured value each) and the largest, in milliseconds; None without any."""
    values = np.asarray(list(delays))
    if not values.size:
        return None, None, None, None
    p50, p95, p99, most = np.percentile(values, [50, 95, 99, 100], method="inverted_cdf") * 1000
    return round(float(p50), 3), round(float(p95), 3), round(float(p99), 3), round(float(most), 3)


def arrival_rate(row: Row) -> float:
    """Messages that arrived in a second, counting the time that the last ones took."""
    return row.delivered / (row.seconds + (row.delay_max_ms or 0.0) / 1000)
