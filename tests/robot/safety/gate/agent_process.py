"""A robot's agent in a process of its own, to be killed: its orchestrator is not there, and its fallback drives."""

import sys
import time
from pathlib import Path

from skytether.messages import Vector3, Wrench, WrenchStamped
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig
from skytether.robot.agent.gated_hardware import GatedHardware
from skytether.robot.safety.client import GateLink


class Pushed:
    """Somebody pushes with 12 N on each arm: the admittance's damping of 60 N s/m makes 0.2 m/s of it."""

    topics = {"force": WrenchStamped}

    def read(self, now):
        return [("force", WrenchStamped(wrench=Wrench(force=Vector3(x=24.0))))]

    def write(self, twist):
        raise AssertionError("the wheels are the gate's")


config = AgentConfig(
    robot="walker", url="http://127.0.0.1:9", token="none", service="virtual-trail", fallback="admittance"
)
with Agent(config, GatedHardware(Pushed(), GateLink(Path(sys.argv[1])))):
    while True:
        time.sleep(1)
