"""Attacks on a robot that is a graph of either generation of ROS: the processes, and a writer."""

from __future__ import annotations

import signal
from collections.abc import Callable
from itertools import permutations
from pathlib import Path

from . import deaths, hardware, stops
from .stage import Stage

ROLES = ("agent", "gate", "guard", "writer")
_FROZEN_S = 1.0
_TRIES = 20_000
_GOES_ON_S = 0.002
"""Between tries: a tenth of a turn."""
_STAND_S = 0.4
"""For the robot to stand by the gate."""


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


def frozen_in_the_midst(
    role: str, what: str, victims: Callable[[Stage], list[int]], dies: str = ""
) -> tuple[str, str, deaths.Run]:
    """An attack: one who publishes velocities is frozen between its last look at the clock and the kernel.

    Args:
        role: Names it.
        what: Who that is, in words.
        victims: Its process.
        dies: Role of another one that is killed meanwhile; empty: none is.
    """

    def run(stage: Stage) -> None:
        (victim,) = victims(stage)
        for _ in range(_TRIES):
            stage.robot.kill(victim, signal.SIGSTOP)
            if _speaks(victim):
                break
            stage.robot.kill(victim, signal.SIGCONT)
            stage.sleep(_GOES_ON_S)
        else:
            stage.wrong("stuck", f"in {_TRIES} tries {what} was never found as it published")
            return
        if dies:
            stage.robot.signal(dies, signal.SIGKILL)
        stage.sleep(_STAND_S)
        stage.robot.kill(victim, signal.SIGCONT)
        if dies:
            stage.robot.go()
        stage.drives_on(f"the robot drives on after {what} was frozen as it published")

    name, also = f"{role}-frozen-in-the-midst", f"; meanwhile the {dies} is killed" if dies else ""
    return f"{name}-{dies}" if dies else name, f"{what} is frozen as it publishes a velocity, and goes on{also}", run


def _speaks(pid: int) -> bool:
    """Whether a process says that it is about to publish a velocity."""
    rows = (line.split() for line in Path("/proc/locks").read_text().splitlines())
    return any(row[1] == "POSIX" and row[4] == str(pid) for row in rows)
