"""Parameters that are numbers of a size and nothing else: one check, and one sentence for what fails it."""

from __future__ import annotations

from collections.abc import Iterable
from math import inf


def check_positive(params: object, what: str, names: Iterable[str], *, zero: bool = False) -> None:
    """Refuse what is not above 0 and finite; NaN is neither.

    Args:
        params: Has these attributes.
        what: Begins the sentence: what the parameters are of.
        names: Of the attributes.
        zero: 0 is good as well.

    Raises:
        ValueError: One is out of its range; the text names it.
    """
    for name in names:
        value = getattr(params, name)
        if not (0 < value < inf or (zero and value == 0)):
            raise ValueError(f"{what}: {name} must be {'0 or above' if zero else 'above 0'} and finite, not {value}")
