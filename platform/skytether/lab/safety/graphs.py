"""Attacks on a robot that is a graph of either generation of ROS: the processes, and a writer."""

from __future__ import annotations

import signal
from collections.abc import Callable
from itertools import permutations

from . import deaths, hardware, stops

ROLES = ("agent", "gate", "guard", "writer")
_FROZEN_S = 1.0


def with_a_writer(add: Callable[[str, str, deaths.Run, float], None]) -> None:
    """Add them, by name, what is done, attack and seconds."""
    for role in ROLES:
        add(f"{role}-killed", f"the {role} is killed", deaths.killed(role), 4)
        add(f"{role}-frozen", f"the {role} is frozen for 1 s, and goes on", deaths.frozen(role, _FROZEN_S), 3)
    for first, second in permutations(("gate", "guard", "writer"), 2):
        add(
            f"{first}-{second}-killed",
            f"the {first} is killed, then the {second}",
            deaths.both_killed(first, second),
            5,
        )
    add("guard-terminated", "the guard is told to end", deaths.ended(signal.SIGTERM, everybody=False), 5)
    add("stop-gate-killed", "a stop is acknowledged, and the gate killed", stops.stop_and_kill("gate"), 5)
    add("wheels-gone", "the wheels' node is gone for 0.5 s", hardware.wheels_gone(0.5), 3)
    add("laser-silent", "the laser falls silent", hardware.blind("nothing any more", lambda _: lambda: None), 4)
