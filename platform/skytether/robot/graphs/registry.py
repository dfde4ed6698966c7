"""The table of the kinds of robot graph, by key of robot.yaml.

Ours are listed; other distributions add theirs by an entry point of the group ``skytether.graphs`` that names a
`GraphKind` under its key. A configuration gets the keys of the table by `with_sections`. One that cannot be loaded
stops nobody but the file that names it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from importlib.metadata import entry_points
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, create_model

from .kind import GraphKind
from .ros1.kind import Ros1
from .ros2.kind import Ros2

GROUP = "skytether.graphs"
GRAPHS: dict[str, GraphKind[Any, Any]] = {kind.key: kind for kind in (Ros1(), Ros2())}
_BROKEN: dict[str, str] = {}

_Model = TypeVar("_Model", bound=BaseModel)


def _add_installed() -> None:
    """Those of other distributions; none takes the place of one that is there."""
    for point in entry_points(group=GROUP):
        if point.name in GRAPHS:
            continue
        try:
            kind = point.load()()
            if not isinstance(kind, GraphKind) or kind.key != point.name:
                raise TypeError(f"{point.value} is no GraphKind whose key is {point.name}")
            GRAPHS[point.name] = kind
        except Exception as error:  # of somebody else's code anything may come
            _BROKEN[point.name] = f"its kind of graph cannot be loaded: {type(error).__name__}: {error}"


_add_installed()


def with_sections(of: Callable[[GraphKind[Any, Any]], type[BaseModel]]) -> Callable[[type[_Model]], type[_Model]]:
    """A decorator of a configuration: it gets a key for each kind of graph.

    Args:
        of: Which of the kind's sections.
    """

    def extend(model: type[_Model]) -> type[_Model]:
        fields: dict[str, Any] = {key: (of(kind) | None, None) for key, kind in GRAPHS.items()}
        for key, why in _BROKEN.items():
            fields[key] = (Annotated[Any, BeforeValidator(partial(_refuse, why))], None)
        made = create_model(model.__name__, __base__=model, __module__=model.__module__, **fields)
        made.__doc__ = model.__doc__
        return made

    return extend


def _refuse(why: str, section: object) -> None:
    if section is not None:
        raise ValueError(why)


def sections_of(config: BaseModel) -> Mapping[str, Any]:
    """The sections that a configuration has, by key."""
    return {key: section for key in GRAPHS if (section := getattr(config, key)) is not None}


def keys(last: str = "or") -> str:
    """All keys in words: ``ros1 or ros2``."""
    *first, final = GRAPHS
    return f"{', '.join(first)} {last} {final}" if first else final
