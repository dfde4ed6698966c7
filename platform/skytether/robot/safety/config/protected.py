"""Which names of the robot's graph are safety's: no service may publish or offer them, whatever is listed. Pure.

Taken from the configuration itself: what the gate listens to (`SafetyConfig.kinds`), and every field that is a topic.
So a source that is added later is protected without being named here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from pydantic import BaseModel

from skytether.ros.names import resolve

from .safety_config import SafetyConfig

_READ = "it is safety's"
_WHEELS = "the wheels listen to it; a service drives by its command topic alone, past the supervisor"


def protected_names(safety: SafetyConfig, home: str, prefix: str = "/") -> dict[str, str]:
    """Names that are never the cloud's: why, by absolute name.

    Args:
        safety: The section of robot.yaml.
        home: Namespace of the robot's topics, where the section names none.
        prefix: What stands before every name of the agent's graph, see `GraphKind.prefix`.
    """
    found: dict[str, str] = {}
    graph = safety.graph
    written = graph is not None and "namespace" in graph.way.model_fields_set
    for namespace in {home, *([graph.way.namespace] if graph is not None and written else [])}:
        found.update({resolve(name, namespace): _READ for name in {*safety.kinds(), *_topics(safety)}})
        if graph is not None:
            found[resolve(graph.way.cmd_vel, namespace)] = _WHEELS
    if graph is not None:
        found.update(graph.kind.spellings(found, graph.way, prefix))
    return found


def _topics(part: object) -> Iterator[str]:
    """Every field that names a topic."""
    if isinstance(part, BaseModel):
        for key in type(part).model_fields:
            value = getattr(part, key)
            if isinstance(value, str) and (key == "topic" or key.endswith("_topic")):
                yield value
            else:
                yield from _topics(value)
    elif isinstance(part, Mapping):
        for value in part.values():
            yield from _topics(value)
    elif isinstance(part, list | tuple):
        for value in part:
            yield from _topics(value)
