"""Hand-over between two networks in mid-stream (Mello, thesis, section 3.5): what is lost, and the longest gap.

A robot that reaches its service over two emulated networks, bound to 127.0.0.1 and 127.0.0.2, sends 128 bytes every
10 ms and gets as much back. At the hand-over its way changes; the first network is cut.
"""

from __future__ import annotations

import os
import threading
import time
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

from skytether.bridge import Bridge, SessionSpec
from skytether.bridge.interfaces import LocalPath
from skytether.bridge.local import GraphPort, LocalGraph
from skytether.emulator.udp_link import LinkConditions, LinkEmulator
from skytether.wire.topic import Direction, PathUse, Role, Topic

SIZE, PERIOD = 128, 0.010
BREAK_AFTER = 0.2
"""Seconds from a planned hand-over until the network that was left is cut."""
HOSTS = ("127.0.0.1", "127.0.0.2")
VARIANTS = ("planned", "redundant", "failover")
"""What happens at the hand-over: the robot prefers the other network, and the first is cut later; the first is cut
without notice while messages go by both; the same while they go by one."""


class HandoverError(Exception):
    """The experiment could not be done; the text says why."""


@dataclass(frozen=True, slots=True)
class Row:
    """One direction of one run."""

    variant: str
    direction: str
    sent: int
    lost: int
    gap_max_ms: float
    """Longest time between two arrivals that follow each other."""
    delay_p50_ms: float

    def document(self) -> dict[str, Any]:
        """As JSON has it."""
        return asdict(self)


class _Flow:
    """Numbered messages of one direction, and when they arrived."""

    def __init__(self, name: str, sender: LocalGraph, receiver: LocalGraph) -> None:
        self._name = name
        self._sender = sender
        self.sent: list[float] = []
        self.arrived: dict[int, float] = {}
        receiver.subscribe(name, self._on_message)

    def send(self) -> None:
        self._sender.publish(self._name, len(self.sent).to_bytes(SIZE, "big"))
        self.sent.append(time.monotonic())

    def _on_message(self, payload: bytes | memoryview) -> None:
        self.arrived[int.from_bytes(payload, "big")] = time.monotonic()

    def row(self, variant: str, direction: str) -> Row:
        times = sorted(self.arrived.values())
        delays = sorted(at - self.sent[n] for n, at in self.arrived.items())
        if not delays:
            raise HandoverError(f"{variant}: nothing arrived")
        gap = max((b - a for a, b in pairwise(times)), default=0.0)
        lost = len(self.sent) - len(self.arrived)
        return Row(
            variant, direction, len(self.sent), lost, round(gap * 1e3, 2), round(delays[len(delays) // 2] * 1e3, 2)
        )


def handover(variant: str, *, seconds: float = 20.0, at: float = 10.0, delay: float = 0.005) -> list[Row]:
    """Do it once.

    Args:
        variant: One of `VARIANTS`.
        seconds: Length of the run.
        at: When the hand-over is, from the first message.
        delay: One way, of the first network; the second takes a millisecond more.

    Raises:
        HandoverError: No session came up.
        ValueError: There is no such variant, or the hand-over is not within the run.
    """
    if variant not in VARIANTS:
        raise ValueError(f"variant must be one of {', '.join(VARIANTS)}, not {variant}")
    if not 0 < at < seconds:
        raise ValueError(f"the hand-over must be within the run of {seconds} s, not at {at} s")
    use = PathUse.REDUNDANT if variant == "redundant" else PathUse.FAILOVER
    topics = tuple(
        Topic(name, "skytether_lab/msg/Numbered", direction, priority=120, lifespan=1.0, depth=100, paths=use)
        for name, direction in (("up", Direction.IN), ("down", Direction.OUT))
    )
    key = os.urandom(32)
    graphs = {role: LocalGraph() for role in Role}

    def spec(role: Role) -> tuple[SessionSpec, GraphPort]:
        return SessionSpec(1, key, role, topics), GraphPort(graphs[role], topics, role)

    with Bridge(*spec(Role.SERVICE)) as service:
        links = [
            LinkEmulator(service.address, up=LinkConditions(delay=d), down=LinkConditions(delay=d), bind=(host, 0))
            for host, d in zip(HOSTS, (delay, delay + 0.001), strict=True)
        ]
        try:
            paths = [LocalPath(link.address[0], cost, link.address) for cost, link in enumerate(links)]
            with Bridge(*spec(Role.ROBOT), peer=links[0].address, paths=paths) as robot:
                _wait_for_both(robot)
                flows = [_Flow("up", graphs[Role.ROBOT], graphs[Role.SERVICE])]
                flows.append(_Flow("down", graphs[Role.SERVICE], graphs[Role.ROBOT]))
                _stream(flows, links[0], robot, variant, seconds, at)
        finally:
            for link in links:
                link.close()
    return [flow.row(variant, name) for flow, name in zip(flows, ("robot to service", "service to robot"), strict=True)]


def _wait_for_both(robot: Bridge) -> None:
    """Until both networks are known to work, and the cheaper one is in use."""
    end = time.monotonic() + 10
    while time.monotonic() < end:
        paths = robot.stats().paths
        if [p.health for p in paths] == ["live", "live"] and paths[0].active:
            # A cheaper network is only preferred after it has been good for a while; so is the one of the hand-over.
            time.sleep(2.2)
            return
        time.sleep(0.02)
    raise HandoverError("the two emulated networks did not come up; does this machine have 127.0.0.2?")


def _stream(flows: list[_Flow], first: LinkEmulator, robot: Bridge, variant: str, seconds: float, at: float) -> None:
    start, wait = time.monotonic(), threading.Event()
    planned = start + at if variant == "planned" else float("inf")
    cut = start + at + (BREAK_AFTER if variant == "planned" else 0.0)
    for number in range(round(seconds / PERIOD)):
        due = start + number * PERIOD  # reckoned anew: sums of a tenth of a tenth drift
        wait.wait(max(0.0, due - time.monotonic()))
        for flow in flows:
            flow.send()
        if due >= planned:
            robot.set_cost(first.address[0], 200)
            planned = float("inf")
        if due >= cut:
            first.set(up=LinkConditions(cut=True), down=LinkConditions(cut=True))
            cut = float("inf")
    wait.wait(1.0)  # what is under way arrives, or never does
