"""Attacks by a service that has gone mad, over a real bridge. What it may publish is tested with the robot's graphs."""

from __future__ import annotations

import signal

from .attacks import Attacks
from .deaths import Run
from .stage import Stage

_MAD_S = 2.0
_MOVES = 0.05
"""Faster than this the service drives the robot [m/s]."""


def enter(attacks: Attacks) -> None:
    """Add them."""
    for kind, what in (
        ("fast", "5 m/s and 9 rad/s"),
        ("jumping", "full speed forward and backward in turn"),
        ("nan", "NaN and infinity among good velocities"),
    ):
        attacks.add(f"cloud-{kind}", f"a service commands {what}; then the agent is killed", _mad(kind), seconds=7)


def _mad(kind: str) -> Run:
    def run(stage: Stage) -> None:
        robot = stage.robot
        robot.signal("agent", signal.SIGKILL)
        agent = robot.helper("skytether.lab.safety.cloud_agent", str(robot.folder), kind)
        try:

            def driven() -> bool:
                robot.start()
                return abs(robot.velocity.linear) > _MOVES

            robot.wait(lambda: robot.velocity.linear == 0, "the robot stands without its agent")
            robot.wait(driven, "the service drives the robot", 0.2)
            stage.sleep(_MAD_S)
            with stage.stands(stage.promised.agent, "the agent of a mad service was killed"):
                agent.kill()
                stage.sleep(0.8)
        finally:
            agent.kill()
            agent.wait()

    return run
