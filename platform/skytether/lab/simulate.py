"""A walk in made-up time: world, delayed and lossy link, controller; no sockets, no threads, far faster than real."""

from __future__ import annotations

from collections import deque
from typing import Protocol

import numpy as np

from skytether.messages import Message, Twist
from skytether.robot.control.command import Source

from .measures import Sample
from .walk import STEP, World


class Controller(Protocol):
    """What runs at the far end of the link."""

    def receive(self, topic: str, message: Message, now: float) -> None:
        """Take a message that arrived now."""
        ...

    def step(self, now: float) -> Twist | None:
        """The command to send now, if any."""
        ...


def simulate(
    world: World,
    controller: Controller,
    *,
    rtt: float = 0.0,
    loss: float = 0.0,
    duration: float = 120.0,
    random: np.random.Generator | None = None,
) -> list[Sample]:
    """Walk for a while.

    The walker repeats the last command that arrived (thesis section 2.5.1): it has no supervisor here.

    Args:
        world: The world, advanced in place.
        controller: The far end.
        rtt: Round trip [s], half each way.
        loss: Share of messages lost, each for itself, each way.
        duration: Simulated time [s].
        random: For the losses; needed if there are any.

    Raises:
        ValueError: There is loss and no generator.
    """
    if loss > 0 and random is None:
        raise ValueError("simulate: loss needs a random generator")
    delay = round(rtt / 2 / STEP)
    up: deque[list[tuple[str, Message]]] = deque([[]] * delay)
    down: deque[Twist | None] = deque([None] * delay)

    def arrives() -> bool:
        return random is None or random.random() >= loss

    command, samples = Twist(), []
    for step in range(round(duration / STEP)):
        now = step * STEP
        sensors = world.step(now, command)
        samples.append(Sample(now, world.pose.x, world.pose.y, Source.CLOUD))
        up.append([entry for entry in sensors.messages() if arrives()])
        for topic, message in up.popleft():
            controller.receive(topic, message, now)
        answer = controller.step(now)
        down.append(answer if arrives() else None)
        command = down.popleft() or command
    return samples
