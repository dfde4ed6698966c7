"""How a topic of the bridge stands in a graph of ROS now: for people, at any time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class Followed:
    """One topic.

    Attributes:
        name: In the service's manifest; of a reading, and of the wheels, the robot's own.
        graph: In the graph.
        type: Of its messages.
        way: ``from`` the graph, or ``to`` it.
        nodes: Who publishes it, or listens to it, as far as the graph tells.
        there: Whether anybody does.
        quality: What those who publish offer, or what we do; in the graph's words.
        refused: Why nothing is carried; empty: it is.
        passed: Messages that were given on between graph and bridge; of the wheels: velocities that were published.
            None: nobody counts them.
        dropped: Messages that could not be.
    """

    name: str
    graph: str
    type: str
    way: Literal["from", "to"]
    nodes: tuple[str, ...] = ()
    there: bool = False
    quality: str = ""
    refused: str = ""
    passed: int | None = None
    dropped: int = 0
