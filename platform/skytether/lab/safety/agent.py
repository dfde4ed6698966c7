"""An agent in a process of its own, to be killed: ``python -m skytether.lab.safety.agent FOLDER WANTED``.

No orchestrator is there, so its fallback drives: somebody pushes and turns the walker, always the same. ``WANTED`` is
the velocity that comes of it, as JSON: ``[m/s, rad/s]``.
"""

from __future__ import annotations

import json
import logging
import sys
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

from skytether.control.admittance import AdmittanceParams
from skytether.messages import Message, Twist, Vector3, Wrench, WrenchStamped
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig
from skytether.robot.agent.gated_hardware import GatedHardware
from skytether.robot.control.supervisor import VelocityLimits
from skytether.robot.safety.client import GateLink

from .robot import LIMITS


class _Pushed:
    """Forces that the walker's own controller makes the wanted velocity of."""

    topics: Mapping[str, type[Message]] = {"force": WrenchStamped}

    def __init__(self, linear: float, angular: float) -> None:
        params = AdmittanceParams()
        force, torque = Vector3(x=2 * params.damping * linear), Vector3(z=params.angular_damping * angular)
        self._wrench = WrenchStamped(wrench=Wrench(force=force, torque=torque))

    def read(self, _now: float) -> Iterable[tuple[str, Message]]:
        return [("force", self._wrench)]

    def write(self, _twist: Twist) -> None:
        raise AssertionError("the wheels are the gate's")


def main() -> None:
    """Drive until killed."""
    folder, (linear, angular) = Path(sys.argv[1]), json.loads(sys.argv[2])
    logging.basicConfig(level=logging.INFO)
    config = AgentConfig(
        robot="walker",
        url="http://127.0.0.1:9",  # nobody answers there
        token="none",  # noqa: S106 - it is no secret
        service="virtual-trail",
        fallback="admittance",
        fallback_options={"max_linear": abs(linear), "max_angular": max(0.1, abs(angular))},
        limits=VelocityLimits(**LIMITS),
    )
    with Agent(config, GatedHardware(_Pushed(linear, angular), GateLink(folder))):
        while True:
            time.sleep(1)


if __name__ == "__main__":
    main()
