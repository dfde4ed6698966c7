"""What ROS gives a node on its command line and in its environment, laid over the robot's file. Pure.

``__name:=``, ``__ns:=`` (and ROS_NAMESPACE), ``__master:=``, ``__ip:=``, ``__hostname:=``, remappings ``from:=to`` and
private parameters ``_name:=value`` (wiki.ros.org/Remapping%20Arguments). Roslaunch gives all of them that way but the
private parameters, which it sets at the master. For a robot of ROS 2 its package (``ros2/skytether``) hands on what
``ros2 launch`` gives it in the same words.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from skytether.api.yaml import YamlError, parse_yaml
from skytether.ros.names import namespace_of, resolve

_OF_GRAPH = ("topics", "use_sim_time")
PRIVATE = ("service", "params", "status_port", *_OF_GRAPH)
"""Keys of robot.yaml (`_OF_GRAPH` of its section ``ros1`` or ``ros2``) that private parameters give: who reaches the
master can set these, so nothing that safety, permissions or the token rely on is among them."""
_GIVEN = {"__name": "name", "__ns": "namespace", "__master": "master", "__ip": "host", "__hostname": "host"}


class ArgumentError(ValueError):
    """A word is no argument of ROS; the text says what it may be."""


@dataclass(frozen=True, slots=True)
class RosArguments:
    """All of them; empty where nothing was given.

    Attributes:
        name: Of the node.
        namespace: That the node is in, and the robot's topics; of ROS 1 only if the file does not say where they are.
        ros1_namespace: ROS_NAMESPACE, which only ROS 1 has; what the command line says is stronger.
        master: Address of the master.
        host: Address of this machine.
        remap: Names of the graph, by name.
        params: Private parameters, by name.
        words: As they were given, to be passed on.
    """

    name: str = ""
    namespace: str = ""
    ros1_namespace: str = ""
    master: str = ""
    host: str = ""
    remap: Mapping[str, str] = field(default_factory=dict)
    params: Mapping[str, Any] = field(default_factory=dict)
    words: tuple[str, ...] = ()

    def private(self, found: object) -> RosArguments:
        """With the private parameters that the master has; those of the command line win."""
        params = dict(found) if isinstance(found, dict) else {}
        return replace(self, params={**params, **self.params})

    @property
    def unused(self) -> list[str]:
        """Private parameters that nobody asks for."""
        return sorted(set(self.params) - set(PRIVATE))

    def over(self, document: Any) -> Any:
        """A robot's file as it is with them; anything else as it is."""
        if not isinstance(document, dict):
            return document
        if isinstance(document.get("ros1"), dict):
            section, graph = "ros1", self._over_ros1(document["ros1"])
        elif isinstance(document.get("ros2"), dict):
            section, graph = "ros2", self._over_ros2(document["ros2"])
        else:
            return document
        home = resolve(str(graph.get("namespace") or namespace_of(str(document.get("robot", "")))), "/")
        wheels = resolve(str(graph.get("cmd_vel", "cmd_vel")), home)
        for old, new in self.remap.items():
            if resolve(old, home) == wheels:
                graph["cmd_vel"] = new
            elif isinstance(graph.get("remap", {}), dict):
                graph["remap"] = {**graph.get("remap", {}), old: new}
        private = {name: self.params[name] for name in PRIVATE if name in self.params}
        graph.update({name: private.pop(name) for name in _OF_GRAPH if name in private})
        return {**document, **private, section: graph}

    def _over_ros1(self, section: dict[str, Any]) -> dict[str, Any]:
        graph, namespace = dict(section), self.namespace or self.ros1_namespace
        if self.name or namespace:
            name = self.name or str(graph.get("node", "skytether"))
            graph["node"] = resolve(name, namespace) if namespace else name
        if namespace and graph.get("namespace") is None:
            graph["namespace"] = namespace
        graph.update({key: value for key, value in (("master", self.master), ("host", self.host)) if value})
        return graph

    def _over_ros2(self, section: dict[str, Any]) -> dict[str, Any]:
        given = {"node": self.name, "namespace": self.namespace}
        return section | {key: value for key, value in given.items() if value}


def parse(words: Iterable[str], environ: Mapping[str, str]) -> RosArguments:
    """Read what ROS gave.

    Raises:
        ArgumentError: A word is none of ROS.
    """
    given: dict[str, str] = {}
    if environ.get("ROS_NAMESPACE"):
        given["ros1_namespace"] = resolve(environ["ROS_NAMESPACE"], "/")
    remap: dict[str, str] = {}
    params: dict[str, Any] = {}
    for word in words:
        name, mark, value = word.partition(":=")
        if not mark or not name:
            raise ArgumentError(
                f"'{word}' is no argument of ROS: these are FROM:=TO, _PARAMETER:=VALUE, {':=, '.join(_GIVEN)}:="
            )
        if name in _GIVEN:
            given[_GIVEN[name]] = resolve(value, "/") if name == "__ns" else value
        elif name.startswith("__"):
            continue  # __log and what else ROS has
        elif name.startswith("_"):
            params[name[1:]] = _value(word, value)
        else:
            remap[name] = value
    return RosArguments(**given, remap=remap, params=params, words=tuple(words))


def _value(word: str, text: str) -> Any:
    """As ROS reads it: YAML."""
    try:
        found = parse_yaml(text.encode(), Path(word))
    except YamlError as error:
        raise ArgumentError(f"{word}: {error}") from error
    return found[0] if found else ""
