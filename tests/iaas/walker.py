"""A simulated walker that asks for virtual-trail, in whatever network namespace it is started: ``run.py`` does.

Prints a line of JSON when the service has driven it for the first time, and another when its input is closed.
"""

from __future__ import annotations

import json
import sys
import time
from itertools import groupby

from skytether.lab.demo import WalkerHardware
from skytether.lab.trail import Trail
from skytether.lab.walk import STEP, World
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig
from skytether.robot.control.command import Source


def main(url: str, token: str, patience_s: float) -> None:
    """Drive until the input is closed."""
    base = WalkerHardware(World(Trail(), seed=1))
    config = AgentConfig(
        robot="walker", url=url, token=token, service="virtual-trail", fallback="admittance", insecure_http=True
    )
    agent = Agent(config, base)
    base.source = lambda: agent.source
    began = time.monotonic()
    with agent:
        if not base.walking.wait(patience_s):
            sys.exit(f"error: the service did not drive the walker: {agent.status().trouble}")
        say(first_command_s=round(time.monotonic() - began, 2))
        sys.stdin.read()
        sources = [sample.source for sample in base.samples]
        base.ended.set()
    runs = [len(list(run)) for source, run in groupby(sources) if source is not Source.CLOUD]
    say(
        driven_s=round(len(sources) * STEP, 1),
        by_the_service=round(sources.count(Source.CLOUD) / len(sources), 3),
        longest_without_s=round(max(runs, default=0) * STEP, 2),
    )


def say(**facts: float) -> None:
    """One line of JSON."""
    sys.stdout.write(json.dumps(facts) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]))
