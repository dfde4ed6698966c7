"""Names of a graph: what ROS allows, and under which name a topic of the bridge lives in a graph. Pure.

(Mello, thesis, section 4.2, figure 24: what a robot sends is found under the robot's namespace, what a service sends
under the service's, in both graphs.) A call or an action lives where it is answered. Absolute names (``/tf``) are taken
as they are. Where the thesis needs relay nodes to reach the rest of the graph, a name is remapped here.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Literal

from skytether.api.manifest import ANY_TOPIC, TopicSpec

Generation = Literal[1, 2]
MAX_NAME = 255

_LEGAL = {1: re.compile(r"[A-Za-z/~][A-Za-z0-9_/]*"), 2: re.compile(r"[A-Za-z_/~][A-Za-z0-9_/]*")}


class GraphNameError(ValueError):
    """A name that ROS does not allow; the text names it and says what it may be."""


def check_name(name: str, ros: Generation = 1) -> str:
    """Give back a graph name that this generation of ROS allows.

    ROS 1 refuses a first character other than a letter, '/' or '~', and takes '_' anywhere else; ROS 2 takes '_' at any
    token's start, but no digit there.

    Raises:
        GraphNameError: It does not allow it.
    """
    if not name or len(name) > MAX_NAME:
        raise GraphNameError(f"'{name[:40]}' is not a valid name of a graph: it must have 1 to {MAX_NAME} characters")
    if not _LEGAL[ros].fullmatch(name):
        first = "a letter, '/' or '~'" if ros == 1 else "a letter, '_', '/' or '~'"
        raise GraphNameError(
            f"'{name}' is not a valid name of a graph: it must begin with {first}, then letters, digits, '_' and '/'"
        )
    if "//" in name or (name.endswith("/") and name != "/"):
        raise GraphNameError(f"'{name}' is not a valid name of a graph: something must follow each '/'")
    if ros == 2 and any(token[:1].isdigit() for token in name.split("/")):
        raise GraphNameError(f"'{name}' is not a valid name of a ROS 2 graph: no part may begin with a digit")
    return name


def namespace_of(name: str) -> str:
    """The namespace of a robot or service: ``virtual-trail`` has ``/virtual_trail``, ``3po`` has ``/_3po``."""
    text = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return "/" + ("_" if text[:1].isdigit() else "") + text


def resolve(name: str, namespace: str, node: str = "") -> str:
    """The absolute name: relative ones are in the namespace, ``~x`` below the node's own name."""
    if name.startswith("~"):
        return f"{node or namespace.rstrip('/')}/{name[1:].lstrip('/')}"
    return name if name.startswith("/") else f"{namespace.rstrip('/')}/{name}"


def ros1_type(name: str) -> str:
    """``sensor_msgs/msg/LaserScan`` as ROS 1 has it: ``sensor_msgs/LaserScan``."""
    package, _, rest = name.partition("/")
    return f"{package}/{rest.rpartition('/')[2]}" if rest else name


def bridge_type(name: str, kind: Literal["msg", "srv"] = "msg") -> str:
    """``sensor_msgs/LaserScan`` as manifests and tables have it: ``sensor_msgs/msg/LaserScan``."""
    package, _, rest = name.partition("/")
    return name if "/" in rest or not rest else f"{package}/{kind}/{rest}"


class Names:
    """Where the topics, calls and actions of one service live in one graph.

    Args:
        specs: The service's topics.
        robot: Namespace of what the robot sends and answers.
        service: Namespace of what the service sends and answers.
        remap: Other names, by topic, call or action, or by the absolute name that it would have; relative ones are in
            the namespace that it would have had.
        ros: Generation, for what is allowed.

    Raises:
        GraphNameError: A name is not allowed in this graph.
    """

    def __init__(
        self,
        specs: Iterable[TopicSpec],
        robot: str,
        service: str,
        remap: Mapping[str, str] | None = None,
        *,
        ros: Generation = 1,
    ) -> None:
        self._ros = ros
        self._robot = robot
        self._remap = dict(remap or {})
        self._names: dict[str, str] = {}
        self._absolute: set[str] = set()
        self._anything = False
        for spec in specs:
            if spec.name == ANY_TOPIC:
                self._anything = True
                continue
            asks = spec.kind != "topic"
            home = robot if (spec.direction == "in") is not asks else service
            name = check_name(self._renamed(spec.name, home), ros)
            self._names[spec.name] = name
            for part in (*spec.parts(), *spec.rows()):
                self._names[part.name] = name + part.name.removeprefix(spec.name)

    def _renamed(self, name: str, home: str) -> str:
        plain = resolve(name, home)
        self._absolute.add(plain)
        return resolve(self._remap.get(name) or self._remap.get(plain, name), home)

    def of(self, topic: str) -> str:
        """The graph's name of a topic, a call or an action of the bridge. What only a row ``*`` takes keeps its name.

        Raises:
            GraphNameError: It is not allowed in this graph.
        """
        known = self._names.get(topic)
        return known or check_name(self._renamed(topic, self._robot), self._ros)

    def own(self, name: str) -> str:
        """The graph's name of something of the robot alone (its wheels, a reading), remapped too.

        Raises:
            GraphNameError: It is not allowed in this graph.
        """
        return check_name(self._renamed(name, self._robot), self._ros)

    def unused(self, more: Iterable[str] = ()) -> list[str]:
        """Remappings of nothing that there is: a typing error, most likely."""
        known = {*self._names, *more, *self._absolute}
        return [] if self._anything else sorted(set(self._remap) - known)
