"""``skytether lab bench bridge``: what is asked for, checked and completed, and the suites run one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from skytether.lab.netns import why_unavailable

from . import conditions
from .conditions import Condition
from .pair import BenchError
from .rows import Row
from .suites import SUITES, Progress, Setup
from .transports import NAMES, TransportError, load

_TCP = Path("/proc/sys/net/ipv4")

__all__ = ["BenchError", "Plan", "make_plan", "run"]


@dataclass(frozen=True, slots=True)
class Plan:
    """What is going to be measured.

    Attributes:
        suite: Name of the suite.
        setup: What the suite is told.
        notes: A sentence about each thing that the reader should know.
    """

    suite: str
    setup: Setup
    notes: tuple[str, ...]

    @property
    def title(self) -> str:
        """One line."""
        return f"{SUITES[self.suite].about}, {self.setup.seconds:g} s each, delays one way in ms"


def make_plan(
    suite: str,
    *,
    condition: Sequence[str] = (),
    transport: Sequence[str] = (),
    seconds: float | None = None,
    emulator: str = "auto",
    congestion: str | None = None,
    camera_last: bool = False,
) -> Plan:
    """Complete what was asked for.

    Args:
        suite: Name of the suite.
        condition: Names of links; empty for the usual ones.
        transport: Names of transports; empty for those that the suite usually compares.
        seconds: Of each measurement; None for the suite's own.
        emulator: ``auto``, ``tun`` or ``user``.
        congestion: Of TCP; None for bbr where it may be used, else cubic, else the machine's default.
        camera_last: Rank the camera below everything, instead of second as in Table 2.

    Raises:
        ValueError: A name is not known; the text lists those that are.
        BenchError: This machine cannot do what is asked for.
    """
    if suite not in SUITES:
        raise ValueError(f"suite '{suite}' is not known; choose from {', '.join(SUITES)}")
    if emulator not in ("auto", "tun", "user"):
        raise ValueError(f"emulator '{emulator}' is not known; choose from auto, tun, user")
    unknown = [name for name in transport if name not in NAMES]
    if unknown:
        raise ValueError(f"transport '{unknown[0]}' is not known; choose from {', '.join(NAMES)}")
    kind = SUITES[suite]
    if condition and not kind.takes_conditions:
        raise ValueError(f"suite '{suite}' has its own link: leave --condition out")
    links: list[Condition] = conditions.find(condition or conditions.DEFAULT) if kind.takes_conditions else []
    notes = []
    used, why = _choose_emulator(emulator) if kind.needs_link else ("none", "")
    if why:
        notes.append(why)
    names, left_out = _usable(transport or kind.transports, used)
    notes += left_out
    if not names:
        raise BenchError("nothing to measure: " + "; ".join(left_out))
    setup = Setup(
        transports=names,
        conditions=tuple(links),
        seconds=seconds if seconds is not None else kind.seconds,
        emulator=used,
        congestion=_choose_congestion(congestion, used),
        camera_last=camera_last,
    )
    return Plan(suite, setup, tuple(notes))


def run(plan: Plan, say: Progress, failed: Callable[[str], None]) -> Iterator[Row]:
    """Measure.

    Args:
        plan: What.
        say: Called with what is being measured now.
        failed: Called with a sentence for each measurement that could not be made; it has no rows.
    """
    return SUITES[plan.suite].run(plan.setup, say, failed)


def _choose_emulator(wanted: str) -> tuple[str, str]:
    """Which emulator to use, and a sentence about it."""
    user = "emulator in user space on loopback: it sees whole datagrams, so plain UDP loses fewer large messages than"
    user += " over IP packets"
    if wanted == "user":
        return "user", user
    trouble = why_unavailable()
    if trouble is None:
        return "tun", "emulator of IP packets between two network namespaces"
    if wanted == "tun":
        raise BenchError(f"the TUN emulator cannot work: {trouble}")
    return "user", f"{user} ({trouble})"


def _choose_congestion(wanted: str | None, emulator: str) -> str:
    """Namespaces may use what the machine allows to everybody; without them there is the machine's default."""
    default = _setting("tcp_congestion_control")
    allowed = _setting("tcp_allowed_congestion_control").split() if emulator == "tun" else [default]
    if wanted is None:
        return next((name for name in ("bbr", "cubic") if name in allowed), default)
    if wanted not in allowed:
        raise BenchError(
            f"congestion control '{wanted}' may not be used here, only {', '.join(allowed)}; "
            f"allow it with: sysctl -w net.ipv4.tcp_allowed_congestion_control='{' '.join([*allowed, wanted])}'"
            if emulator == "tun"
            else f"congestion control '{wanted}' needs the TUN emulator; without it there is this machine's, {default}"
        )
    return wanted


def _setting(name: str) -> str:
    file = _TCP / name
    return file.read_text().strip() if file.exists() else "unknown"


def _usable(names: Sequence[str], emulator: str) -> tuple[tuple[str, ...], list[str]]:
    """Transports that can work here, and why the others cannot."""
    found, left_out = [], []
    for name in names:
        try:
            kind = load(name)
            kind.check()
        except TransportError as error:
            left_out.append(f"{name} is left out: {error}")
            continue
        if (kind.TCP or kind.TUN) and emulator == "user":
            why = "is carried by TCP" if kind.TCP else "uses several ports"
            left_out.append(f"{name} is left out: it {why} and needs the TUN emulator, so root")
        else:
            found.append(name)
    return tuple(found), left_out
