"""The links that transports are compared on, by name. Delays are one way; both directions are alike."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from skytether.emulator.link_model import LinkConditions

SWEEP = (0, 1, 2, 5, 10, 15, 20, 25, 30)
"""Losses of ``sweep``, percent."""
_SEED = 7


@dataclass(frozen=True, slots=True)
class Condition:
    """A link with a name: what both of its directions do."""

    name: str
    link: LinkConditions
    about: str


def _condition(name: str, about: str, **link: float) -> Condition:
    return Condition(name, LinkConditions(seed=_SEED, **link), about)  # type: ignore[arg-type]


_NAMED = (
    _condition("ideal", "no delay, no loss"),
    _condition("50ms-1%", "50 ms, 1 % loss", delay=0.05, loss=0.01),
    _condition("50ms-5%", "50 ms, 5 % loss", delay=0.05, loss=0.05),
    _condition(
        "commercial",
        "62 ms, 14 ms jitter, 0.25 % loss, 20 Mbit/s",
        delay=0.062,
        jitter=0.014,
        loss=0.0025,
        rate=20e6,
    ),
    _condition(
        "private",
        "98 ms, 24 ms jitter, 2.7 % loss, 20 Mbit/s",
        delay=0.098,
        jitter=0.024,
        loss=0.027,
        rate=20e6,
    ),
    _condition("burst", "30 ms, 3 % loss in bursts of 4", delay=0.03, loss=0.03, burst=4),
)
_ORDERED = tuple(
    Condition(f"{c.name}-ordered", replace(c.link, jitter_reorders=False), f"{c.about}; jitter never reorders")
    for c in _NAMED
    if c.link.jitter
)
_SWEEP = tuple(_condition(f"loss-{p}%", f"50 ms, {p} % loss", delay=0.05, loss=p / 100) for p in SWEEP)
_ALL = {c.name: c for c in (*_NAMED, *_ORDERED, *_SWEEP)}

DEFAULT = tuple(c.name for c in _NAMED)
NAMES = (*DEFAULT, *(c.name for c in _ORDERED), "sweep")
"""What may be asked for; ``loss-N%`` of the sweep too."""

SATURATED = _condition("5Mbit", "20 ms, 5 Mbit/s", delay=0.02, rate=5e6)
"""For the suite that fills a link with the camera."""


def find(names: Iterable[str]) -> list[Condition]:
    """Conditions by name, each once; ``sweep`` stands for all of its losses.

    Raises:
        ValueError: A name is not known; the text lists those that are.
    """
    found: dict[str, Condition] = {}
    for name in names:
        if name == "sweep":
            found.update((c.name, c) for c in _SWEEP)
        elif name in _ALL:
            found[name] = _ALL[name]
        else:
            raise ValueError(f"condition '{name}' is not known; choose from {', '.join(NAMES)}")
    return list(found.values())
