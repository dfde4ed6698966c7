"""Patterns of schemas, in time that grows with the text and nothing else.

Python's own engine tries all ways in which a pattern may match, of which `(a+)+$` has 2 ** n for n letters: 26 of them
held the orchestrator up for 6 s and more. RE2 takes 10 us for 20,000, and for a name, too, where Python's takes 1 us.
It lacks what cannot be had in such time, which is told when a manifest is taken: back references, and looking ahead
and behind. All that JSON Schema's keywords search for goes this way: `pattern`, `patternProperties`, and what asks
which keys the latter covers. (`validation_budget` makes a validator of them.)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from typing import Any

import re2
from jsonschema.exceptions import ValidationError

_MEMORY = 1 << 20
"""Bytes that one pattern may take: a thousand characters, or a hundred repetitions of ten."""
_LONGEST = 1024
"""Characters of a pattern."""


@lru_cache(maxsize=256)
def _compiled(pattern: str) -> Any:
    options = re2.Options()
    options.max_mem = _MEMORY
    options.log_errors = False
    return re2.compile(pattern, options)


@lru_cache(maxsize=256)
def wrong_with(pattern: str) -> str:
    """Why a pattern cannot be used; empty: it can."""
    if len(pattern) > _LONGEST:
        return f"has {len(pattern)} characters: at most {_LONGEST} can be used"
    try:
        _compiled(pattern)
    except re2.error as error:
        why = error.args[0] if error.args else ""
        why = why.decode(errors="replace") if isinstance(why, bytes) else str(why)
        return f"is no pattern that can be used ({why}); RE2 has no back references, and looks neither ahead nor behind"
    return ""


class PatternError(Exception):
    """A pattern or a keyword that cannot be used, in a manifest from the time when others could."""


def found(pattern: str, text: str) -> bool:
    """Whether a pattern is found anywhere in a text.

    Raises:
        PatternError: It cannot be used.
    """
    if why := wrong_with(pattern):
        raise PatternError(f"'{pattern[:80]}' {why}")
    return _compiled(pattern).search(text) is not None


def _pattern(validator: Any, pattern: str, instance: Any, _: Any) -> Iterator[ValidationError]:
    if validator.is_type(instance, "string") and not found(pattern, instance):
        yield ValidationError(f"{instance!r} does not match {pattern!r}")


def _pattern_properties(
    validator: Any, patterns: Mapping[str, Any], instance: Any, _: Any
) -> Iterator[ValidationError]:
    if not validator.is_type(instance, "object"):
        return
    for pattern, schema in patterns.items():
        for key, value in instance.items():
            if found(pattern, key):
                yield from validator.descend(value, schema, path=key, schema_path=pattern)


def _additional_properties(validator: Any, allowed: Any, instance: Any, schema: Any) -> Iterator[ValidationError]:
    if not validator.is_type(instance, "object"):
        return
    known, patterns = schema.get("properties", {}), schema.get("patternProperties", {})
    extra = [key for key in instance if key not in known and not any(found(pattern, key) for pattern in patterns)]
    if validator.is_type(allowed, "object"):
        for key in extra:
            yield from validator.descend(instance[key], allowed, path=key)
    elif not allowed and extra:
        keys = ", ".join(repr(key) for key in sorted(extra))
        yield ValidationError(f"additional keys are not allowed: {keys}")


KEYWORDS: dict[str, Callable[[Any, Any, Any, Any], Iterator[ValidationError]]] = {
    "pattern": _pattern,
    "patternProperties": _pattern_properties,
    "additionalProperties": _additional_properties,
}
"""In place of those of the library."""
