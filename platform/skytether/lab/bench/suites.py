"""The suites: which traffic meets which link, and what the rows of each are called."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from skytether.emulator.link_model import LinkConditions

from . import traffic
from .conditions import SATURATED, Condition
from .pair import BenchError, Pair
from .rows import Row
from .traffic import Flow
from .transports import NAMES

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Setup:
    """What a suite is told.

    Attributes:
        transports: By name, in this order.
        conditions: Links, for a suite that takes them.
        seconds: Of each measurement.
        emulator: ``tun``, ``user`` or ``none``.
        congestion: Of TCP.
        camera_last: Rank the camera below everything, instead of second as in Table 2.
    """

    transports: tuple[str, ...]
    conditions: tuple[Condition, ...]
    seconds: float
    emulator: str
    congestion: str
    camera_last: bool = False

    def pair(
        self,
        transport: str,
        flows: Sequence[Flow],
        condition: str,
        link: LinkConditions | None,
        options: dict[str, Any] | None = None,
    ) -> Pair:
        """Two connected ends of a transport."""
        return Pair(
            transport,
            flows,
            condition=condition,
            link=link,
            emulator=self.emulator,
            congestion=self.congestion,
            options=options,
        )


@dataclass(frozen=True, slots=True)
class Suite:
    """One kind of measurement.

    Attributes:
        run: Measures; called with the set-up, what to tell of progress, and what to tell of failures.
        about: One line for the report.
        transports: Compared unless others are asked for.
        seconds: Of each measurement unless told otherwise.
        needs_link: Whether there is an emulated link.
        takes_conditions: Whether the link may be chosen.
    """

    run: Callable[[Setup, Progress, Progress], Iterator[Row]]
    about: str
    transports: tuple[str, ...]
    seconds: float
    needs_link: bool
    takes_conditions: bool = False


def _table2(setup: Setup, say: Progress, failed: Progress) -> Iterator[Row]:
    flows = traffic.camera_last(traffic.TABLE2) if setup.camera_last else traffic.TABLE2
    for condition in setup.conditions:
        for name in setup.transports:
            say(f"{name} under {condition.name} ({condition.about})")
            try:
                with setup.pair(name, flows, condition.name, condition.link) as pair:
                    yield from pair.measure(setup.seconds)
            except BenchError as error:
                failed(str(error))


def _fig26(setup: Setup, say: Progress, failed: Progress) -> Iterator[Row]:
    for name in setup.transports:
        for topics in FIG26_TOPICS:
            cells = [(kb, hz) for kb in traffic.SIZES_KB for hz in traffic.RATES_HZ]
            if topics == 1:
                cells += [(traffic.FRAME_KB, hz) for hz in traffic.FRAME_RATES_HZ]
            try:
                with setup.pair(name, traffic.fig26(topics, *cells[-1]), "loopback", None) as pair:
                    for kb, hz in cells:
                        cell = fig26_cell(topics, kb, hz)
                        say(f"{name}: {cell}")
                        yield from pair.measure(
                            setup.seconds, flows=traffic.fig26(topics, kb, hz), condition=cell, warm_up=0.2
                        )
            except BenchError as error:
                failed(str(error))


def _throughput(setup: Setup, say: Progress, failed: Progress) -> Iterator[Row]:
    steps = [(64 * traffic.KB, mbps * 1e6 / 8 / 64 / traffic.KB, f"{mbps} Mbit/s") for mbps in OFFERED_MBPS]
    steps += [(SMALL, float(hz), f"{hz} messages/s") for hz in OFFERED_HZ]
    for name in setup.transports:
        for size, hz, offered in steps:
            say(f"{name}: {size} B at {offered}")
            flows = traffic.stream(size, hz)
            try:
                with setup.pair(name, flows, f"{size} B, {offered}", None, UNLIMITED) as pair:
                    yield from pair.measure(setup.seconds, warm_up=2.0)
            except BenchError as error:
                failed(str(error))


def _saturated(setup: Setup, say: Progress, failed: Progress) -> Iterator[Row]:
    camera = replace(traffic.CAMERA, rank=2)
    loads = (("idle", traffic.COMMANDS), ("saturated", (*traffic.COMMANDS, camera)))
    for name in setup.transports:
        for load, flows in loads:
            condition = f"{SATURATED.name} {load}"
            say(f"{name}: {condition} ({SATURATED.about})")
            try:
                with setup.pair(name, flows, condition, SATURATED.link) as pair:
                    yield from pair.measure(setup.seconds, warm_up=2.0)
            except BenchError as error:
                failed(str(error))


def _latency(setup: Setup, say: Progress, failed: Progress) -> Iterator[Row]:
    for name in setup.transports:
        say(f"{name}: latency on loopback")
        try:
            with setup.pair(name, traffic.LATENCY, "loopback", None) as pair:
                yield from pair.measure(setup.seconds, warm_up=0.5)
        except BenchError as error:
            failed(str(error))


FIG26_TOPICS = (1, 5)
"""The scenarios of figure 26."""
OFFERED_MBPS = (100, 250, 500, 750, 1000)
SMALL = 100
OFFERED_HZ = (5_000, 10_000, 20_000, 30_000, 40_000)
UNLIMITED = {"rate_bps": 1.2e9, "burst": 65_507}
"""Pacing where the question is what processor and kernel can do: as much at once as a system call takes, at a rate
above what they can, yet with a first burst that the receiver's buffer holds."""


def fig26_cell(topics: int, size_kb: float, hz: float) -> str:
    """How the rows of a cell are called."""
    return f"{topics} topic{'s' if topics > 1 else ''}, {size_kb:g} kB, {hz:.0f} Hz"


SUITES = {
    "table2": Suite(
        _table2,
        "traffic of the thesis's Table 2",
        NAMES,
        10.0,
        needs_link=True,
        takes_conditions=True,
    ),
    "fig26": Suite(
        _fig26,
        "message loss over size and rate on loopback, as in the thesis's figure 26",
        ("skytether",),
        3.0,
        needs_link=False,
    ),
    "throughput": Suite(_throughput, "throughput and message rate on loopback", ("skytether",), 3.0, needs_link=False),
    "saturated": Suite(
        _saturated,
        f"velocity commands while the camera fills a link of {SATURATED.about}",
        NAMES,
        10.0,
        needs_link=True,
    ),
    "latency": Suite(_latency, "latency on loopback, without any emulator", NAMES, 5.0, needs_link=False),
}
