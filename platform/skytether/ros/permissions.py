"""What the other end of a session may publish, call and offer in this graph. Pure.

A manifest names topics, and absolute names reach the whole graph. So what may be made of it at the robot is the robot's
decision: names below the service's own namespace, and what robot.yaml lists. What safety reads, and what the wheels
listen to, is never the cloud's, whatever is listed and however it is spelt.

Refusals are asked for when a session begins, and again with every message and call (`skytether.ros.ros1.port`,
`skytether.ros.ros2.port`).
"""

from __future__ import annotations

import re
import unicodedata
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache

from skytether.api.manifest import ANY_TOPIC, TopicSpec

from .names import Names


class Access(StrEnum):
    """What is done with a name; the values are keys of ``cloud`` in robot.yaml."""

    PUBLISH = "publish"
    """A topic, or one of an action's."""
    CALL = "call"
    """A service of the robot's nodes, or one of an action's in ROS 2."""
    OFFER = "offer"
    """A service that the robot's nodes may call."""


_DONE = {Access.PUBLISH: "published", Access.CALL: "called", Access.OFFER: "offered"}

TIME = {"/clock": "it tells every node the time"}
"""Never the cloud's, in any graph."""
_SETTERS = frozenset({"set_parameters", "set_parameters_atomically", "change_state", "load_node", "unload_node"})
"""Services that turn a node into something else (ROS 2's parameters, life cycle and components; dynamic_reconfigure).

A namespace in the list does not include them: a driver whose parameters change may see less. They are listed in full.
"""
_DDS_PREFIXES = re.compile(r"^(/r[tqr])+(?=/)")
"""What DDS puts before the names of topics, requests and replies; an older bridge to DDS takes keys that have it."""
_REMEMBERED = 4096
"""Names whose canonical form is kept: as many as a session's tables have rows, with room."""


@dataclass(frozen=True, slots=True)
class Allowed:
    """What robot.yaml lists; absolute names. A name includes all below it, but for `_SETTERS`.

    Attributes:
        publish: Topics.
        call: Services of the robot's nodes.
        offer: Services for the robot's nodes.
    """

    publish: Collection[str] = ()
    call: Collection[str] = ()
    offer: Collection[str] = ()

    def of(self, access: Access) -> Collection[str]:
        """The list for one kind of access."""
        names: Collection[str] = getattr(self, access.value)
        return names


NOTHING_MORE = Allowed()
"""The service's own namespace alone."""


class Permissions:
    """The robot's decision.

    Args:
        home: Namespace of the robot's own topics.
        service: Namespace of what the service sends; allowed, but for what of it is the robot's.
        allowed: What is listed.
        protected: Never allowed: why, by absolute name.
    """

    def __init__(self, home: str, service: str, allowed: Allowed, protected: Mapping[str, str]) -> None:
        self._home = home
        self._service = service
        self._allowed = allowed
        self._protected = {canonical(name): why for name, why in {**TIME, **protected}.items()}

    def protected(self, name: str) -> str:
        """Why a name is never the cloud's; empty: it is not protected."""
        return self._protected.get(canonical(name), "")

    def refusal(self, access: Access, name: str) -> str:
        """Why a name of the graph must not be used so: a sentence; empty: it may be.

        Args:
            access: What is to be done with it.
            name: Absolute.
        """
        why = self.protected(name)
        if why:
            return f"{name} is never {_DONE[access]} for the cloud: {why}"
        if name in self._allowed.of(access) or self._included(access, name):
            return ""
        return (
            f"{name} is not {_DONE[access]} for the cloud, because robot.yaml does not allow it; "
            f"if it is wanted, write there: cloud: {{{access}: [{name}]}}"
        )

    def _included(self, access: Access, name: str) -> bool:
        """Whether it is below a name that is allowed."""
        if name.rpartition("/")[2] in _SETTERS:
            return False
        if any(within(name, listed) for listed in self._allowed.of(access)):
            return True
        # A service that is called as the robot, or as a namespace around it, is not given the robot's own topics.
        robots = self._home != "/" and within(self._home, self._service) and within(name, self._home)
        return access is not Access.CALL and within(name, self._service) and not robots


def refused(
    permissions: Permissions, specs: Iterable[TopicSpec], names: Names, command_topic: str
) -> list[tuple[str, str, str]]:
    """All rows of a service that the robot does not allow: name of the row, name in the graph, sentence.

    Args:
        permissions: The robot's.
        specs: The service's topics.
        names: Theirs in the robot's graph.
        command_topic: The row that drives; it is never in the graph.
    """
    found = []
    for row, access, name in _uses(specs, names, command_topic):
        sentence = permissions.refusal(access, name)
        if sentence:
            found.append((row, name, sentence))
    return found


def check(permissions: Permissions, specs: Iterable[TopicSpec], names: Names, command_topic: str) -> None:
    """See that the robot allows everything that a service wants; arguments as for `refused`.

    Raises:
        ValueError: It does not; the text names each.
    """
    never, unlisted = [], defaultdict[Access, list[str]](list)
    for row, access, name in _uses(specs, names, command_topic):
        sentence = permissions.refusal(access, name)
        if sentence and permissions.protected(name):
            never.append(f"the service's '{row}': {sentence}")
        elif sentence:
            unlisted[access].append(name)
    if unlisted:
        lists = ", ".join(f"{access}: [{', '.join(named)}]" for access, named in unlisted.items())
        all_of_them = ", ".join(name for named in unlisted.values() for name in named)
        never.append(
            f"the service wants {all_of_them}, which robot.yaml does not allow; what of it is wanted is written there: "
            f"cloud: {{{lists}}}"
        )
    if never:
        raise ValueError("; ".join(never))


def canonical(name: str) -> str:
    """One spelling for all that some part of a graph might take for the same name."""
    return _canonical(name)


@lru_cache(_REMEMBERED)
def _canonical(name: str) -> str:
    text = unicodedata.normalize("NFKC", name).casefold()
    text = re.sub(r"[/\s~]+", "/", f"/{text}/")
    return _DDS_PREFIXES.sub("", text).rstrip("/") or "/"


def within(name: str, namespace: str) -> bool:
    """Whether a name is a namespace, or below it."""
    return name == namespace or name.startswith(namespace.rstrip("/") + "/")


def _uses(specs: Iterable[TopicSpec], names: Names, command_topic: str) -> Iterator[tuple[str, Access, str]]:
    for spec in specs:
        if spec.name == ANY_TOPIC:
            continue
        for part in spec.parts():
            if part.kind == "call":
                yield part.name, Access.OFFER if part.direction == "in" else Access.CALL, names.of(part.name)
                continue
            for row in part.rows():
                if row.direction == "out" and row.name != command_topic:
                    yield row.name, Access.PUBLISH, names.of(row.name)
