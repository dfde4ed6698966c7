"""Checks by a schema that end soon, whatever the schema says.

A schema of 30 lines takes 2 ** 30 steps, where each of its definitions refers twice to the next one; so does a small
one that refers to itself twice, with parameters of 30 levels. 16 such checks kept everybody waiting until the
orchestrator was killed: it could not even end. So steps are counted, and the larger the parameters, the more a check
may take.

A step is one keyword at one place, each turn of a loop over what the keyword or the parameters hold, and a part of what
an error's text says of the parameters; each takes some microseconds. What the library does without keywords of its
own being asked is replaced, or not taken: equal items are found by a set, not each beside each, and what asks which
keys or items other keywords have seen (`unevaluatedProperties`, `unevaluatedItems`) looks for that in a way of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from jsonschema import Draft202012Validator
from jsonschema.exceptions import ValidationError
from jsonschema.validators import extend

from .patterns import KEYWORDS, PatternError

_STEPS = 5_000
"""Of a check, however small the parameters."""
_STEPS_EACH = 8
"""More of them for each number, key and text in the parameters. A list of poses takes 2, one of bounded numbers 5."""
_LETTERS = 32
"""Of a text count as much as one number."""
_TOLD = 8
"""Numbers that are compared, or told in an error's text, take a step."""
_WALKS = ("items", "prefixItems", "contains", "additionalProperties", "patternProperties", "propertyNames")
"""Keywords that look at each item or key of the parameters; `uniqueItems`, too, at all below them."""
_COMPARES = ("const", "enum", "dependentRequired")
"""Those that look at all that their own value holds."""
UNUSABLE = {"unevaluatedProperties": "additionalProperties", "unevaluatedItems": "items"}
"""Keywords that are not taken, and what to write instead."""

_Check = Callable[[Any, Any, Any, Any], Iterator[ValidationError] | None]


class BudgetError(Exception):
    """A check would take more steps than it may."""


class _Budget:
    """Steps that are left to one check."""

    def __init__(self, document: Any) -> None:
        self._sizes: dict[int, int] = {}
        """Of each list and mapping of the document, by identity: they are looked at again and again."""
        self.steps = self.left = _STEPS + _STEPS_EACH * self._weigh(document)

    def spend(self, steps: int) -> None:
        self.left -= steps
        if self.left < 0:
            raise BudgetError(f"take more than {self.steps} steps to check")

    def size(self, value: Any) -> int:
        """Of a part of the document."""
        if isinstance(value, str):
            return 1 + len(value) // _LETTERS
        return self._sizes.get(id(value), 1) if isinstance(value, list | Mapping) else 1

    def _weigh(self, value: Any) -> int:
        if not isinstance(value, list | Mapping):
            return self.size(value)
        self._sizes[id(value)] = size = 1 + sum(map(self._weigh, _parts(value)))
        return size


_budget: ContextVar[_Budget | None] = ContextVar("_budget", default=None)
"""Of the check that runs; none: it is one of ours, with as many steps as it needs."""


@contextmanager
def bounded(document: Any) -> Iterator[None]:
    """Within, a check of this document, or a part of it, ends.

    Raises:
        BudgetError: It would have taken too many steps.
    """
    before = _budget.set(_Budget(document))
    try:
        yield
    finally:
        _budget.reset(before)


def _parts(value: Any) -> Iterator[Any]:
    if isinstance(value, Mapping):
        yield from value
        yield from value.values()
    elif isinstance(value, list):
        yield from value


def _all_in(value: Any) -> int:
    return 1 + sum(map(_all_in, _parts(value)))


def _counted(keyword: str, check: _Check) -> _Check:
    def counting(validator: Any, value: Any, instance: Any, schema: Any) -> Iterator[ValidationError] | None:
        budget = _budget.get()
        if budget is not None:
            budget.spend(_steps(keyword, value, instance, schema, budget))
        return check(validator, value, instance, schema)

    return counting


def _steps(keyword: str, value: Any, instance: Any, schema: Any, budget: _Budget) -> int:
    size = budget.size(instance)
    steps = 1 + size // _TOLD
    if keyword in _COMPARES:
        steps += _all_in(value) // _TOLD
    elif isinstance(value, list | Mapping):
        steps += len(value)
    elif isinstance(value, str):
        steps += value.count("/")  # of a reference: it is followed part by part
    if keyword in _WALKS and isinstance(instance, list | Mapping):
        patterns = schema.get("patternProperties") if keyword in ("patternProperties", "additionalProperties") else None
        steps += len(instance) * (1 + (len(patterns) if isinstance(patterns, Mapping) else 0))
    return steps + size if keyword == "uniqueItems" else steps


def _unique_items(validator: Any, wanted: Any, instance: Any, _: Any) -> Iterator[ValidationError]:
    if wanted and validator.is_type(instance, "array") and len({_same(item) for item in instance}) < len(instance):
        yield ValidationError(f"{instance!r} has items that are equal")


def _same(value: Any) -> Any:
    """The same for what JSON Schema calls equal: 1 and 1.0, but not 1 and true."""
    if isinstance(value, bool):
        return "bool", value
    if isinstance(value, list):
        return "list", tuple(map(_same, value))
    if isinstance(value, Mapping):
        return "mapping", frozenset((key, _same(one)) for key, one in value.items())
    return value


def _not_taken(keyword: str) -> _Check:
    def refuse(*_: Any) -> Iterator[ValidationError]:
        raise PatternError(f"'{keyword}' cannot be used; write {UNUSABLE[keyword]}")

    return refuse


_OWN: dict[str, _Check] = {**KEYWORDS, "uniqueItems": _unique_items} | {word: _not_taken(word) for word in UNUSABLE}

Validator: Any = extend(
    Draft202012Validator,
    {word: _counted(word, check) for word, check in {**Draft202012Validator.VALIDATORS, **_OWN}.items()},
)
"""JSON Schema 2020-12, with patterns in linear time, and within `bounded` with a bound."""


def _evolve(validator: Any, **changes: Any) -> Any:
    given = {field.alias: getattr(validator, field.name) for field in validator.__attrs_attrs__ if field.init}
    return type(validator)(**(given | changes))


# The library's own takes the class that `$schema` names, for each part of a schema that has one: Python's patterns, and
# no bound. What is taken here is 2020-12, whatever is written there.
Validator.evolve = _evolve
