"""The fallback `trail` on the robot's own control loop, with the simulated walker and person, in made-up time."""

from itertools import count, pairwise

import pytest

from skytether.lab.demo import WalkerHardware
from skytether.lab.measures import measure
from skytether.lab.trail import Trail
from skytether.lab.walk import World
from skytether.messages import Twist, Vector3, encode
from skytether.robot.control.arbiter import LinkRequirements
from skytether.robot.control.command import Source
from skytether.robot.control.control_loop import ControlLoop
from skytether.robot.control.supervisor import VelocityLimits
from skytether.robot.session.session import LiveSession
from skytether.wire.events import Connected, Disconnected, MessageReceived
from skytether_services.virtual_trail.fallback import HoldTrail

TICK = 0.01


class Walk:
    """The walker's control loop, tick by tick."""

    def __init__(self, **options):
        self.base = WalkerHardware(World(Trail(), seed=1))
        self.base.walking.set()
        self.driver = ControlLoop(self.base, HoldTrail(**options), VelocityLimits(), LinkRequirements(), 100.0)
        self.base.source = lambda: self.driver.source
        self.ticks = count(1)
        self.told = []

    def run(self, seconds, cloud=lambda now: None):
        for _ in range(round(seconds / TICK)):
            now = 100.0 + next(self.ticks) * TICK
            cloud(now)
            self.driver.tick(now)
            self.told.append(self.driver.status().velocity)


@pytest.mark.slow
def test_the_trail_is_held_without_any_service():
    walk = Walk()
    walk.run(46.0)
    result = measure(walk.base.samples, Trail())
    assert result.completed
    assert result.kte_m < 0.03
    assert walk.driver.status().errors == {}


def test_it_goes_on_where_the_service_left_without_a_jump():
    walk, number = Walk(), count()
    session = LiveSession("1", frozenset(), "cmd_vel", count(1))
    session.notify(Connected(()))
    walk.driver.session = session

    def command(now):
        payload = encode(Twist(Vector3(x=0.2), Vector3(z=0.0)))
        session.deliver(MessageReceived("cmd_vel", payload, next(number), now - 0.02, 0.01, now))

    walk.run(4.0, command)
    assert walk.driver.source is Source.CLOUD
    session.notify(Disconnected("silent"))
    walk.run(3.0)
    assert walk.driver.source is Source.FALLBACK
    around = walk.told[395:450]
    assert (
        max(abs(b.linear - a.linear) for a, b in pairwise(around)) <= VelocityLimits().linear_acceleration * TICK + 1e-9
    )
    assert min(v.linear for v in around) > 0.1, "the person is not held up"
    assert abs(Trail().locate(walk.base.world.pose.x, walk.base.world.pose.y).offset) < 0.05


def test_without_its_readings_it_says_nothing():
    fallback = HoldTrail()
    fallback.watch(walk_velocity := Walk().driver.status().velocity, {}, TICK)
    assert fallback.step(walk_velocity, {}, TICK) is None


@pytest.mark.parametrize("options", [{"speed": 1.0}, {"trail": []}, {"admittance_mass": -1.0}])
def test_what_the_service_would_refuse_it_refuses(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        HoldTrail(**options)
