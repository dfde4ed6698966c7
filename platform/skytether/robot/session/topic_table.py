"""The robot's topic table: what it offers of what the service takes, in the robot's encoding. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

from skytether.api.manifest import ANY_TOPIC, TopicSpec
from skytether.bridge.spec import topic_from_api
from skytether.wire.topic import Topic


@dataclass(frozen=True, slots=True)
class Offer:
    """A topic that the robot can send.

    Attributes:
        type: ROS 2 style type name.
        type_hash: ROS 1 MD5 or ROS 2 RIHS01; empty: not checked.
        encoding: ``cdr`` or ``ros1``.
    """

    type: str
    type_hash: str = ""
    encoding: str = "cdr"


def spoken(specs: Iterable[TopicSpec], actions: Literal["action", "ros2_action"] | None) -> list[TopicSpec]:
    """Of a service's rows those that a robot can speak: one manifest is for robots of either ROS, and of none.

    Args:
        specs: All of them.
        actions: The kind of the actions in the robot's graph; None: it has no graph, and so none.
    """
    return [spec for spec in specs if spec.kind in ("topic", "call", actions)]


def robot_table(specs: Iterable[TopicSpec], offers: Mapping[str, Offer], *, encoding: str = "cdr") -> tuple[Topic, ...]:
    """Join what a service takes with what a robot offers.

    A row of the service that the robot offers too carries the robot's type, hash and encoding (a wrong type is told by
    the handshake, which names both). A row ``*`` takes every other offer with its quality of service. Offers that the
    service does not take are left out. The service's own topics are all wanted, and its calls.

    Args:
        specs: The service's topics, from the session.
        offers: The robot's, by name.
        encoding: In which the robot wants the service's topics.
    """
    parts = [part for spec in specs for part in spec.parts()]
    everything = [row for part in parts for row in (part.rows() if part.kind == "action" else (part,))]
    rows = [spec for spec in everything if spec.kind == "topic"]
    named = {spec.name: spec for spec in rows}
    anything = named.pop(ANY_TOPIC, None)
    table = [_topic(spec, spec.name, Offer(spec.type, "", encoding)) for spec in rows if spec.direction == "out"]
    calls = [row for spec in everything if spec.kind == "call" for row in spec.rows()]
    table += [_topic(row, row.name, Offer(row.type, "", encoding)) for row in calls]
    for name, offer in offers.items():
        row = named.get(name, anything)
        if row is not None and row.direction == "in":
            table.append(_topic(row, name, offer))
    return tuple(table)


def _topic(spec: TopicSpec, name: str, offer: Offer) -> Topic:
    return replace(topic_from_api(spec), name=name, type=offer.type, type_hash=offer.type_hash, encoding=offer.encoding)
