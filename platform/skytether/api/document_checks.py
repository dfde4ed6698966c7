"""What documents may hold: what every JSON reader and every database can keep, and give back as it was."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable
from math import isfinite
from typing import Any

from .validation_errors import Fault

DEPTH = 64
"""Levels of a document: what is deeper would exhaust the stack of some reader. People need ten."""
KEYS = 4096
"""Of a document, its lists aside. People need hundreds; each that nobody knows is a fault to find, and costs all who
ask."""
LISTED_KEYS = 20_000
"""In its lists: a robot reports 16 of each of a thousand topics. Reading a robot's rows stops at a fault."""
_WHOLE = 1 << 63

_Odd = tuple[list[str], str]
"""The place, its innermost part first, and what is wrong there."""


def oddity(document: Any, text: bytes = b"") -> Fault | None:
    """What JSON, a database or UTF-8 has no word for; None: all is well.

    A NaN would arrive as null, and half of a character or a number with a thousand digits could be stored, but never
    read again. Of a key that comes twice readers take one and say nothing.

    Args:
        document: What was read.
        text: The JSON that it was read from, where somebody wrote one.
    """
    keys = [0, 0]

    def check(value: Any, depth: int, listed: bool) -> _Odd | None:
        """Where a request holds a hundred numbers: no place is written down before something is wrong there."""
        inner: Iterable[tuple[Any, Any]]
        if isinstance(value, dict):
            keys[listed] += len(value)
            inner = value.items()
        elif isinstance(value, list):
            inner, listed = enumerate(value), True
        else:
            trouble = _of_scalar(value)
            return None if trouble is None else ([], trouble)
        if depth >= DEPTH:
            return [], f"is nested more than {DEPTH} levels deep"
        for key, one in inner:
            trouble = _of_text(key) if isinstance(key, str) else None
            if trouble is not None:
                return [], f"one of its keys {trouble}"
            odd = check(one, depth + 1, listed)
            if odd is not None:
                odd[0].append(str(key))
                return odd
        return None

    odd = check(document, 0, False)
    if odd is not None:
        place, trouble = odd[0][::-1], odd[1]
        return Fault(".".join(place if len(place) < DEPTH else place[:3]), trouble)
    for count, most, where in zip(keys, (KEYS, LISTED_KEYS), ("", " in lists"), strict=True):
        if count > most:
            return Fault("", f"has more than {most} keys{where}")
    # A colon follows each key: no more colons than keys, and none was dropped; then there is no need to look again.
    return _doubled(text) if text.count(b":") > sum(keys) else None


def _doubled(text: bytes) -> Fault | None:
    twice: list[str] = []

    def note_doubled(pairs: list[tuple[str, Any]]) -> None:
        counts = Counter(key for key, _ in pairs)
        twice.extend(key for key, count in counts.items() if count > 1)

    json.loads(text, object_pairs_hook=note_doubled)
    if not twice:
        return None
    key = twice[0][:40].encode(errors="backslashreplace").decode()  # it may be in what was dropped, and so anything
    return Fault("", f"the key '{key}' comes twice: leave one of them out")


def _of_scalar(value: Any) -> str | None:
    if isinstance(value, str):
        return _of_text(value)
    if isinstance(value, float):
        return None if isfinite(value) else f"must be a finite number, not {value}"
    if isinstance(value, int):
        return None if -_WHOLE <= value < _WHOLE else "must be a whole number of at most 64 bits"
    return None if value is None else f"must be text, a number, true or false, not {value!r:.40}; quote what is text"


def _of_text(text: str) -> str | None:
    if "\0" in text:
        return "holds a NUL character: leave it out"
    if not text.isascii() and any("\ud800" <= c <= "\udfff" for c in text):
        return "holds half a character (a lone surrogate): leave it out"
    return None
