"""What is wrong with a document that somebody wrote, in words: full key path, and the keys that there are."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import islice
from typing import Any

from pydantic import BaseModel, ValidationError

MAX_FAULTS = 10
"""More help nobody, and a document of some kilobytes can have a hundred thousand."""
_BRANCH = re.compile(r"(literal|tuple|list|dict)\[.*\]", re.DOTALL)
"""What pydantic puts into a path where a value may be of several kinds; nobody wrote it."""


@dataclass(frozen=True)
class Fault:
    """One wrong key of a document: where, and what is wrong with it."""

    key: str
    """Path with dots, ``spec.topics.0.prority``; empty: the document itself."""
    detail: str

    def __str__(self) -> str:
        return f"{self.key}: {self.detail}" if self.key else self.detail


def explain(error: ValidationError, model: type[BaseModel], prefix: Sequence[str] = ()) -> list[Fault]:
    """Pydantic's error in words.

    Args:
        error: What the model said of a document.
        model: The model.
        prefix: Where the document is in a larger one.
    """
    return faults(error.errors(), _schema_of(model), prefix)


@cache
def _schema_of(model: type[BaseModel]) -> Mapping[str, Any]:
    """It takes ten times as long to make as the model takes to find the fault."""
    return model.model_json_schema()


def faults(errors: Iterable[Mapping[str, Any]], schema: Mapping[str, Any], prefix: Sequence[str] = ()) -> list[Fault]:
    """The same of errors that pydantic listed; ``schema`` is the document's JSON schema, to find known keys in."""
    found = []
    for error in islice(errors, MAX_FAULTS):
        path = [step for step in error["loc"] if not (isinstance(step, str) and _BRANCH.fullmatch(step))]
        if error["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
            detail = unknown(str(path[-1]), _keys(schema, path[:-1]))
        elif error["type"] == "missing":
            detail = "is missing"
        elif error["type"] in ("model_type", "model_attributes_type", "dict_type"):
            detail = "must be a mapping of keys to values"
        elif error["type"] == "int_parsing_size":
            detail = "must be a whole number of a size that there is"
        elif error["type"] == "path_type":
            detail = "must be the path of a file"
        else:
            message = str(error["msg"]).removeprefix("Value error, ")
            detail = message[:1].lower() + message[1:]
        found.append(Fault(".".join([*prefix, *(str(p) for p in path)]), detail))
    return found


def unknown(key: str, known: Iterable[str]) -> str:
    """What to say of an unknown key."""
    candidates = list(known)
    near = difflib.get_close_matches(key, candidates, n=1)
    if near:
        return f"unknown key, did you mean '{near[0]}'?"
    return f"unknown key; known are {', '.join(candidates)}" if candidates else "unknown key; there are none"


def known(names: Iterable[str], wrong: str) -> str:
    """How a sentence on a name that there is not goes on: those there are, and the one that was meant perhaps."""
    there = sorted(names)
    near = difflib.get_close_matches(wrong, there, n=1)
    return f"known are: {', '.join(there) or 'none'}" + (f"; did you mean '{near[0]}'?" if near else "")


def _keys(schema: Mapping[str, Any], path: Sequence[Any]) -> list[str]:
    """Known keys at a place in a document, by its JSON schema."""
    places = [schema]
    for step in [*path, None]:
        places = [_resolve(schema, place) for place in places]
        places = [p for place in places for p in (place, *(_resolve(schema, a) for a in place.get("anyOf", [])))]
        if step is None:
            break
        if isinstance(step, int):
            places = [place["items"] for place in places if isinstance(place.get("items"), Mapping)]
        else:
            places = [found for place in places if isinstance(found := _under(place, step), Mapping)]
    return sorted({key for place in places for key in place.get("properties", {})})


def _under(place: Mapping[str, Any], step: str) -> Any:
    """The schema of what a key holds; None if there is none."""
    return place.get("properties", {}).get(step) or place.get("additionalProperties")


def _resolve(schema: Mapping[str, Any], place: Mapping[str, Any]) -> Mapping[str, Any]:
    if "$ref" in place:
        found = schema.get("$defs", {}).get(str(place["$ref"]).removeprefix("#/$defs/"), {})
        return found if isinstance(found, Mapping) else {}
    return place
