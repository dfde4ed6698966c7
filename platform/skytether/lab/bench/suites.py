"""The suites: which traffic meets which link, and what the rows of each are called."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from skytether.lab.link_model import LinkConditions

from . import traffic
from .conditions import Condition
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


SUITES = {
    "table2": Suite(
        _table2,
        "traffic of the thesis's Table 2",
        NAMES,
        10.0,
        needs_link=True,
        takes_conditions=True,
    ),
}
