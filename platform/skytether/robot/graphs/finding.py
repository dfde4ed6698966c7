"""What ``skytether robot run --check`` and ``skytether doctor`` find in a robot's graph, row by row. Pure."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from skytether.api.manifest import TopicSpec
from skytether.ros.names import Names
from skytether.ros.permissions import Permissions, refused

from .wheels_watch import UNNAMED, sentence, strangers, unnamed


@dataclass(frozen=True, slots=True)
class Finding:
    """One row of the answer.

    Attributes:
        what: Topic of the bridge, or what else is needed.
        where: Its name in the graph, or its address.
        kind: Its type.
        says: What was found.
        good: Whether that will do; a topic that nobody publishes yet will.
        missing: It is waited for.
        check: The doctor's name for it, where it has a row of its own there.
        todo: What mends it, for the doctor; empty: give the topic the type.
    """

    what: str
    where: str
    kind: str
    says: str
    good: bool = True
    missing: bool = False
    check: str = ""
    todo: str = ""


def other_publishers(topic: str | None, found: Collection[str], own: Collection[str]) -> list[Finding]:
    """Who else tells the wheels what to do."""
    names = (*strangers(found, own), *([UNNAMED] if unnamed(found, own) else []))
    if topic is None or not names:
        return []
    return [Finding("wheels", topic, "", sentence(topic, names), good=False)]


def forbidden(permissions: Permissions, specs: Sequence[TopicSpec], names: Names, command_topic: str) -> list[Finding]:
    """What the service wants in the graph and is not allowed: with any of it there is no session."""
    return [
        Finding(row, name, "", sentence, good=False)
        for row, name, sentence in refused(permissions, specs, names, command_topic)
    ]


def unknown(name: str) -> Finding:
    """A remapping of nothing that there is."""
    return Finding(f"remap.{name}", "", "", "the service has no such topic, call or action", good=False)
