"""Which names of the robot's graph are safety's: no service may publish or offer them, whatever is listed. Pure.

Taken from the configuration itself: what the gate listens to (`SafetyConfig.kinds`), and every field that is a topic.
So a source that is added later is protected without being named here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from pydantic import BaseModel

from skytether.ros.names import resolve

from .config import Ros1Way, Ros2Way, SafetyConfig

_READ = "it is safety's"
_WHEELS = "the wheels listen to it; a service drives by its command topic alone, past the supervisor"


def protected_names(safety: SafetyConfig, home: str, bridge_namespace: str = "/") -> dict[str, str]:
    """Names that are never the cloud's: why, by absolute name.

    Args:
        safety: The section of robot.yaml.
        home: Namespace of the robot's topics, where the section names none.
        bridge_namespace: What a bridge to DDS puts before every name of the agent's graph.
    """
    found: dict[str, str] = {}
    ways = [way for way in (safety.ros1, safety.ros2) if way is not None]
    for namespace in {home, *(way.namespace for way in ways if "namespace" in way.model_fields_set)}:
        found.update({resolve(name, namespace): _READ for name in {*safety.kinds(), *_topics(safety)}})
        found.update({resolve(way.cmd_vel, namespace): _WHEELS for way in ways})
    for way in ways:
        found.update(_bridged(found, way, bridge_namespace))
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


def _bridged(names: Mapping[str, str], way: Ros1Way | Ros2Way, bridge_namespace: str) -> dict[str, str]:
    """The gate's keys of Zenoh as the agent's graph spells them, where its bridge to DDS has another namespace."""
    if not isinstance(way, Ros2Way) or "bridge_namespace" not in way.model_fields_set:
        return {}
    theirs, ours = way.bridge_namespace.rstrip("/"), bridge_namespace.rstrip("/")
    keys = {f"{theirs}{name}": why for name, why in names.items()}
    return {key.removeprefix(ours): why for key, why in keys.items() if key.startswith(f"{ours}/")}
