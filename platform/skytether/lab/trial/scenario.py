"""Where a service runs, as the robot sees it, and what one trial is asked for. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from skytether.emulator.udp_link import LinkConditions

ROBOT_CPU = 0.25
"""Processors of the robot's computer, in those of this machine: the Pioneer LX has an Atom of two slow cores (thesis,
section 5.2), here taken for an eighth of one of ours each. An assumption, not a measurement."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """Where the service runs, as seen from the robot.

    Attributes:
        name: For tables.
        rtt_s: Round trip of the network [s].
        jitter_s: Standard deviation of the round trip [s].
        loss: Share of round trips that are lost.
        params: Of the service, where they differ.
        cpu: Processors that the service gets at most; None: all. Then it runs on the robot itself.
    """

    name: str
    rtt_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    params: Mapping[str, Any] = field(default_factory=dict)
    cpu: float | None = None

    def link(self, seed: int, direction: int) -> LinkConditions:
        """One direction of the network, 0 or 1: half of the delay, of its variance and of the loss."""
        loss = 1 - math.sqrt(1 - self.loss)
        deviation = self.jitter_s / math.sqrt(2)
        return LinkConditions(delay=self.rtt_s / 2, jitter=deviation, loss=loss, seed=2 * seed + direction)


@dataclass(frozen=True, slots=True)
class TrialSettings:
    """One trial. Experiments add what they ask beyond it.

    Attributes:
        scenario: Where the service runs.
        seed: Of sensor noise and network, and of whoever else acts by chance.
        docker: Options of a Docker site to run the service on; None: as a process.
        image: The service's, on that site; none: the manifest's.
        start_limit_s: The robot must move by then [s].
        drive_limit_s: And the task be done by then [s].
    """

    scenario: Scenario
    seed: int = 1
    docker: Mapping[str, Any] | None = None
    image: str = ""
    start_limit_s: float = 300.0
    drive_limit_s: float = 400.0

    def document(self) -> dict[str, Any]:
        """All that a trial's result depends on, for `KeptTrials`."""
        scenario = self.scenario
        network = {"rtt_s": scenario.rtt_s, "jitter_s": scenario.jitter_s, "loss": scenario.loss}
        asked: dict[str, Any] = {"scenario": scenario.name, "seed": self.seed, **network}
        return {**asked, "cpu": scenario.cpu, "params": dict(scenario.params), "image": self.image}
