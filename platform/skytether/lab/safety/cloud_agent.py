"""An agent that a service drives which has gone mad: ``python -m skytether.lab.safety.cloud_agent FOLDER KIND``.

Both ends of a real bridge, in one process; the orchestrator that grants the session is made up.
"""

from __future__ import annotations

import base64
import os
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from itertools import cycle, repeat
from math import inf, nan
from pathlib import Path

from skytether.api import rest
from skytether.api.manifest import Needs, TopicSpec
from skytether.bridge import Bridge, SessionSpec
from skytether.bridge.local import GraphPort, LocalGraph
from skytether.lab.granted import Granted
from skytether.messages import Message, Twist, Vector3, encode
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig
from skytether.robot.agent.gated_hardware import GatedHardware
from skytether.robot.control.supervisor import VelocityLimits
from skytether.robot.safety.client import GateLink
from skytether.wire.topic import Role

from .robot import LIMITS

_RATE_HZ = 50.0


def wants(kind: str) -> Iterator[tuple[float, float]]:
    """What the service commands, one after the other [m/s, rad/s]."""
    if kind == "fast":
        return repeat((5.0, 9.0))
    if kind == "jumping":
        return cycle([(0.5, 0.8)] * 20 + [(-0.5, -0.8)] * 20)
    # Long enough without nonsense for the agent to take the cloud back.
    return cycle([(0.5, 0.3)] * 90 + [(nan, 0.0), (inf, nan), (0.5, -inf)] * 10)


class _Nothing:
    """A robot without sensors of its own."""

    topics: Mapping[str, type[Message]] = {}

    def read(self, _now: float) -> Iterable[tuple[str, Message]]:
        return ()

    def write(self, _twist: Twist) -> None:
        raise AssertionError("the wheels are the gate's")


def main() -> None:
    """Drive until killed."""
    folder, kind = Path(sys.argv[1]), sys.argv[2]
    topic = TopicSpec(name="cmd_vel", type=Twist.TYPE, direction="out", priority=127, period_ms=1000 / _RATE_HZ)
    session = rest.Session(
        id=os.urandom(8).hex(),
        key=base64.b64encode(os.urandom(32)).decode(),
        topics=(topic,),
        needs=Needs(max_rtt_ms=500),
    )
    spec = SessionSpec.from_api(Role.SERVICE, session.id, session.key or "", session.topics)
    config = AgentConfig(
        robot="bench", url="", token="", service="bench", limits=VelocityLimits(**LIMITS), bind=("127.0.0.1", 0)
    )
    with Bridge(spec, GraphPort(LocalGraph(), spec.topics, Role.SERVICE)) as bridge:
        host, port = bridge.address[:2]
        placed = session.model_copy(update={"host": host, "port": port})
        with Agent(config, GatedHardware(_Nothing(), GateLink(folder)), client=Granted(placed)):
            for linear, angular in wants(kind):
                bridge.publish("cmd_vel", encode(Twist(linear=Vector3(x=linear), angular=Vector3(z=angular))))
                time.sleep(1 / _RATE_HZ)


if __name__ == "__main__":
    main()
