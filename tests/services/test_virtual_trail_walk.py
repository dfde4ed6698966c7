"""The real service, its codec included, guides the simulated walker and person over a slow link, in made-up time."""

import math

import numpy as np
import pytest

from skytether.lab.measures import Measures, measure
from skytether.lab.simulate import simulate
from skytether.lab.trail import Trail
from skytether.lab.walk import STEP, World
from skytether.messages import Message, Twist
from skytether.testing.service import Harness
from skytether_services.virtual_trail.service import VirtualTrail

TRAIL = Trail()


class Remote:
    """The service at the far end of the link."""

    def __init__(self) -> None:
        self.harness = Harness(VirtualTrail, {})
        self._sent = self.harness.outputs["cmd_vel"]

    def receive(self, topic: str, message: Message, now: float) -> None:
        self.harness.send(topic, message)

    def step(self, now: float) -> Twist | None:
        self._sent.clear()
        self.harness.step(STEP)
        return self._sent[-1] if self._sent else None  # type: ignore[return-value]


def walk(*, rtt: float, loss: float = 0.0, seed: int = 1, duration: float = 46.0) -> tuple[World, Measures]:
    world = World(TRAIL, seed=seed)
    samples = simulate(world, Remote(), rtt=rtt, loss=loss, duration=duration, random=np.random.default_rng(seed))
    return world, measure(samples, TRAIL)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rtt", "loss"),
    [(0.0, 0.0), (0.1, 0.05), (0.3, 0.0), (0.5, 0.3)],
)
def test_guides_along_the_trail(rtt: float, loss: float) -> None:
    world, result = walk(rtt=rtt, loss=loss)
    assert result.completed
    assert result.kte_m < 0.03
    assert result.deviation_max_m < 0.1
    assert 0.15 < result.mean_speed_m_s < 0.25
    # Stopped at the end and stays there, though the person may still push.
    assert abs(world.velocity.linear) < 1e-3
    assert math.dist(world.pose[:2], TRAIL.end[:2]) < 0.1


@pytest.mark.slow
def test_a_restarted_service_goes_on_where_the_walker_is() -> None:
    class Restarting(Remote):
        def step(self, now: float) -> Twist | None:
            if round(now / STEP) == 2000:
                before = self.harness.now
                super().__init__()
                self.harness.now = before
            return super().step(now)

    world = World(TRAIL, seed=2)
    result = measure(simulate(world, Restarting(), rtt=0.1, duration=46.0), TRAIL)
    assert result.completed
    assert result.kte_m < 0.03


@pytest.mark.slow
def test_finds_back_from_beside_the_trail() -> None:
    world = World(TRAIL, seed=3)
    world.walker.pose = world.walker.odometry = world.pose._replace(y=0.4, heading=0.3)
    samples = simulate(world, Remote(), rtt=0.5, duration=46.0)
    late = [sample for sample in samples if sample.time > 20.0]
    assert measure(samples, TRAIL).completed
    offsets = [abs(TRAIL.locate(sample.x, sample.y).offset) for sample in late[::50]]
    assert max(offsets) < 0.08
