"""Prometheus' text format for families of many samples that are all known at once.

The client library's own families and formatter do the same, and look at each name in each line anew: ten thousand lines
would keep a program busy for a third of a second.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from operator import getitem, itemgetter
from typing import Literal

from prometheus_client.utils import floatToGoString

_PLAIN = 1e6
"""From here on Prometheus writes numbers otherwise than Python does."""


Sample = tuple[tuple[str, ...], float]
"""Values of labels, and the value."""


@dataclass(frozen=True, slots=True)
class Family:
    """A metric with its samples.

    Attributes:
        name: As in the text; a counter's ends in ``_total``.
        kind: Its type.
        text: Its description.
        labels: Their names, at least one; like the metric's, in ASCII letters, digits and underscores.
        samples: Each with its labels' values, which may hold anything, in the same order.
    """

    name: str
    kind: Literal["counter", "gauge"]
    text: str
    labels: tuple[str, ...]
    samples: Iterable[Sample]


class Sums(dict[tuple[str, ...], float]):
    """Samples by labels. A robot may hold two instances of one service: counts add up, and of gauges the last stays."""

    def add(self, labels: tuple[str, ...], value: float) -> None:
        """One more."""
        self[labels] = self.get(labels, 0.0) + value

    def put(self, labels: tuple[str, ...], value: float | None) -> None:
        """The value now, if it is known."""
        if value is not None:
            self[labels] = value


def gauge(name: str, text: str, labels: Iterable[str], samples: Mapping[tuple[str, ...], float]) -> Family:
    """A gauge of ours with its samples."""
    return Family(f"skytether_{name}", "gauge", text, tuple(labels), samples.items())


def counter(name: str, text: str, labels: Iterable[str], samples: Iterable[Sample]) -> Family:
    """A counter of ours with its samples."""
    return Family(f"skytether_{name}_total", "counter", text, tuple(labels), samples)


def exposition(families: Iterable[Family]) -> bytes:
    """In Prometheus' text format, with the labels in the order of their names."""
    pairs: dict[str, _Pairs] = {}
    lines = []
    for family in families:
        text = family.text.replace("\\", r"\\").replace("\n", r"\n")
        lines.append(f"# HELP {family.name} {text}\n# TYPE {family.name} {family.kind}\n")
        places = sorted(range(len(family.labels)), key=family.labels.__getitem__)
        ordered = itemgetter(*places) if len(places) > 1 else tuple
        labels = [pairs.setdefault(family.labels[i], _Pairs(family.labels[i])) for i in places]
        lines += [
            f"{family.name}{{{','.join(map(getitem, labels, ordered(key)))}}} {_number(value)}\n"
            for key, value in family.samples
        ]
    return "".join(lines).encode()


class _Pairs(dict[str, str]):
    """A label with each of its values, as they are written: few, and each in many lines."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __missing__(self, value: str) -> str:
        escaped = value.replace("\\", r"\\").replace("\n", r"\n").replace('"', r"\"")
        text = self[value] = f'{self._name}="{escaped}"'
        return text


def _number(value: float) -> str:
    return repr(float(value)) if -_PLAIN < value < _PLAIN else floatToGoString(value)
