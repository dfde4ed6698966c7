"""How much an instance should have, by what it took of late: pure, with time and observations as arguments.

Cores grow as soon as most of them have been busy for some seconds, or steps take longer than they may; memory as soon
as most of it is used. Both shrink only when far less was enough for a minute. What is aimed for lies between the two
bounds, so that a steady load is answered once; a size that proved too small is not tried again for longer and longer.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

from skytether.api.manifest import CpuRange, MemoryRange, Scaling
from skytether.api.rest import Size

WINDOW_S = 5.0
"""Over which the use of processors is averaged, at least: what is told more seldom, from one reading to the next."""
STALE_S = 20.0
"""A reading of processor time that has not changed for so long: nothing was used since."""
HOLD_S = 3.0
"""For so long there is too little before there is more."""
PAUSE_S = 10.0
"""Between two changes, at least."""
CALM_S = 60.0
"""For so long there is far too much before there is less."""
CALM_MOST_S = 3600.0
"""The same, of an instance whose size proved too small again and again."""
REVERSAL_S = 300.0
"""A size that is too small within so long of having been made smaller was a mistake."""
GROWTH = 2.0
"""The largest factor of one change, up or down."""
SLOWER = 1.5
"""The factor for steps that take too long while the cores are not busy."""
OUT_OF_MEMORY = 1.5
"""The factor for memory that was not enough."""
BUSY, FULL = 0.8, 0.8
"""Share of cores, and of memory, above which there is too little."""
AIM_CPU, AIM_MEMORY = 0.6, 0.65
"""Share that is aimed for."""
WORTH = 0.8
"""A smaller size is worth a change from this share of the present one on."""
QUICK = 0.6
"""Steps that take more than this share of what they may are no sign of too many cores."""
CORES, MIB = 0.05, 16
"""Sizes are multiples of these."""
ROOM_MB = 32
"""Memory [MiB] that is left beside what is used, however little that is."""


class InstanceSample(NamedTuple):
    """An instance as it was seen at one moment; None: not known."""

    cpu_s: float | None = None
    """Processor time of this run so far."""
    memory_bytes: int | None = None
    step_s: float | None = None
    """Of 20 of its last steps 19 took no longer."""
    attempt: int = 1


class Reading(NamedTuple):
    """A reading of processor time, when it was first seen."""

    at: float
    cpu_s: float


@dataclass(frozen=True, slots=True)
class Lane:
    """What is remembered of cores, or of memory."""

    changed_at: float = -math.inf
    short_since: float | None = None
    """Since when there is too little; None: there is not."""
    calm_since: float | None = None
    calm_peak: float = 0.0
    """The most that was used since then."""
    shrunk_at: float = -math.inf
    patience_s: float = CALM_S


@dataclass(frozen=True, slots=True)
class Trend:
    """What is remembered of one instance."""

    size: Size
    attempt: int = 1
    cpu: Lane = Lane()
    memory: Lane = Lane()
    readings: tuple[Reading, ...] = ()


class Proposal(NamedTuple):
    """Another size."""

    size: Size
    reason: str
    """``busy``, ``slow``, ``memory`` or ``idle``: for metrics."""
    why: str
    """Continues "... instead of ...:"."""


def decide(
    scaling: Scaling, size: Size, trend: Trend | None, seen: InstanceSample, now: float
) -> tuple[Trend, Proposal | None]:
    """Whether an instance should have another size.

    Args:
        scaling: Its bounds.
        size: What it has.
        trend: What came of the last call; None: this is the first.
        seen: As it is now.
        now: Seconds of a clock that nobody sets.

    Returns:
        What to remember; and the size that it should have, if that is another one.
    """
    trend = _taken_up(trend, size, seen, now)
    used, trend = _cores(trend, seen, now)
    cpu, memory, cores, mib = trend.cpu, trend.memory, size.cpu, size.memory_mb
    told: list[tuple[str, str]] = []
    if scaling.cpu is not None and used is not None:
        cpu, cores = _of_cpu(scaling, scaling.cpu, cpu, size.cpu, used, seen.step_s, now, told)
    if scaling.memory_mb is not None and seen.memory_bytes is not None:
        memory, mib = _of_memory(scaling.memory_mb, memory, size.memory_mb, seen.memory_bytes / 2**20, now, told)
    trend = replace(trend, cpu=cpu, memory=memory)
    if not told:
        return trend, None
    wanted = Size(cpu=round(cores, 3), memory_mb=mib)
    return trend, Proposal(wanted, told[0][0], "; ".join(why for _, why in told))


def _of_cpu(
    scaling: Scaling,
    range_: CpuRange,
    lane: Lane,
    has: float,
    used: float,
    step_s: float | None,
    now: float,
    told: list[tuple[str, str]],
) -> tuple[Lane, float]:
    may_ms, takes_ms = scaling.step_ms or math.inf, (step_s or 0.0) * 1e3
    slow, busy = takes_ms > may_ms, used > BUSY * has
    lane, cores = _next(
        lane,
        has,
        used,
        now,
        short=busy or slow,
        calm=takes_ms <= QUICK * may_ms,
        target=lambda n: max(_up(n / AIM_CPU, CORES), has * SLOWER if slow else 0.0),
        bounds=(range_.min, range_.max),
        step=CORES,
    )
    if cores > has:
        load = f"{used:.2f} cores are busy" if busy else ""
        steps = f"19 of 20 steps take up to {takes_ms:.3g} ms, and may take {may_ms:g} ms" if slow else ""
        told.append(("busy" if busy else "slow", " and ".join(filter(None, (load, steps)))))
    elif cores < has:
        told.append(("idle", f"at most {lane.calm_peak:.2f} cores were busy for {lane.patience_s:g} s"))
    return lane, cores


def _of_memory(
    range_: MemoryRange, lane: Lane, has: int, used: float, now: float, told: list[tuple[str, str]]
) -> tuple[Lane, int]:
    lane, mib = _next(
        lane,
        has,
        used,
        now,
        short=used > FULL * has or has - used < ROOM_MB / 2,
        calm=True,
        target=lambda n: _up(max(n / AIM_MEMORY, n + ROOM_MB), MIB),
        bounds=(range_.min, range_.max),
        step=MIB,
    )
    if mib > has:
        told.append(("memory", f"{used:.0f} MiB are used"))
    elif mib < has:
        told.append(("idle", f"at most {lane.calm_peak:.0f} MiB were used for {lane.patience_s:g} s"))
    return lane, int(mib)


def more_memory(range_: MemoryRange, has: Size) -> Size:
    """What an instance is to have that ran out of memory."""
    memory = int(min(_up(has.memory_mb * OUT_OF_MEMORY, MIB), range_.max))
    return Size(cpu=has.cpu, memory_mb=max(memory, has.memory_mb))


def bounded(wanted: Size, has: Size, room: Size) -> Size:
    """As much of it as there is room for, beside what the instance has."""
    cpu = min(wanted.cpu, max(has.cpu, _down(has.cpu + max(0.0, room.cpu), CORES)))
    memory = min(wanted.memory_mb, max(has.memory_mb, int(_down(has.memory_mb + max(0, room.memory_mb), MIB))))
    return Size(cpu=round(cpu, 3), memory_mb=memory)


def _taken_up(trend: Trend | None, size: Size, seen: InstanceSample, now: float) -> Trend:
    if trend is None:
        return Trend(size, seen.attempt)
    if seen.attempt != trend.attempt:  # another run, which counts from zero
        trend = replace(trend, attempt=seen.attempt, readings=())
    if trend.size == size:
        return trend
    cpu, memory = (
        replace(lane, changed_at=now, short_since=None, calm_since=None) if changed else lane
        for lane, changed in (
            (trend.cpu, size.cpu != trend.size.cpu),
            (trend.memory, size.memory_mb != trend.size.memory_mb),
        )
    )
    return replace(trend, size=size, cpu=cpu, memory=memory)


def _cores(trend: Trend, seen: InstanceSample, now: float) -> tuple[float | None, Trend]:
    """How many were busy of late; None: not known yet."""
    if seen.cpu_s is None:
        return None, trend
    readings = trend.readings
    if not readings or seen.cpu_s != readings[-1].cpu_s:
        readings = (*readings, Reading(now, seen.cpu_s))
    last = readings[-1]
    before = [reading for reading in readings if reading.at <= last.at - WINDOW_S]
    if before:
        readings = readings[len(before) - 1 :]  # one at least as old as the window is long
    first = readings[0]
    trend = replace(trend, readings=readings)
    until = now if now - last.at > STALE_S else last.at
    if until - first.at < WINDOW_S:
        return None, trend
    return max(0.0, last.cpu_s - first.cpu_s) / (until - first.at), trend


def _next(
    lane: Lane,
    has: float,
    used: float,
    now: float,
    *,
    short: bool,
    calm: bool,
    target: Callable[[float], float],
    bounds: tuple[float, float],
    step: float,
) -> tuple[Lane, float]:
    """What is remembered, and how much there is to be."""
    least, most = bounds
    rests = now - lane.changed_at < PAUSE_S
    if short:
        since = now if lane.short_since is None else lane.short_since
        lane = replace(lane, short_since=since, calm_since=None)
        wanted = min(max(target(used), least), most, has * GROWTH)
        if wanted <= has or rests or now - since < HOLD_S:
            return lane, has
        mistaken = now - lane.shrunk_at < REVERSAL_S
        patience = min(lane.patience_s * 2, CALM_MOST_S) if mistaken else CALM_S
        return replace(lane, changed_at=now, short_since=None, patience_s=patience), wanted
    lane = replace(lane, short_since=None)
    if not calm or target(used) > WORTH * has:
        return replace(lane, calm_since=None), has
    peak = used if lane.calm_since is None else max(used, lane.calm_peak)
    lane = replace(lane, calm_since=now if lane.calm_since is None else lane.calm_since, calm_peak=peak)
    wanted = max(target(peak), least, _up(has / GROWTH, step))
    if wanted > WORTH * has or rests or now - (lane.calm_since or now) < lane.patience_s:
        return lane, has
    return replace(lane, changed_at=now, calm_since=None, shrunk_at=now), wanted


def _up(number: float, step: float) -> float:
    return math.ceil(number / step - 1e-9) * step


def _down(number: float, step: float) -> float:
    return math.floor(number / step + 1e-9) * step
