"""Sessions joined by a made-up link."""

from random import Random

import pytest

from skytether.testing.link import LossyLink
from skytether.wire import Config, Direction, Role, Session, Topic

KEY = bytes(range(32))
SESSION_ID = 0x1122334455667788

TOPICS = (
    Topic("scan", "sensor_msgs/msg/LaserScan", Direction.IN, priority=100, lifespan=0.2, delivery=0.99),
    Topic("camera", "sensor_msgs/msg/CompressedImage", Direction.IN, priority=10, lifespan=0.5, depth=4),
    Topic("log", "std_msgs/msg/String", Direction.IN, priority=50, lifespan=1.0, depth=1000),
    Topic("cmd_vel", "geometry_msgs/msg/Twist", Direction.OUT, priority=127, lifespan=0.1, delivery=0.999),
    Topic("map", "nav_msgs/msg/OccupancyGrid", Direction.OUT, priority=1, lifespan=5.0, depth=3),
)


class World:
    """Makes sessions and links with made-up randomness."""

    key = KEY
    """Of a session that is made without another."""

    def __init__(self, seed=0):
        self.random = Random(seed)

    def session(self, role, *, topics=TOPICS, key=KEY, session_id=SESSION_ID, config=None, now=0.0):
        return Session(role, session_id, key, topics, config=config, entropy=self.random.randbytes, now=now)

    def link(self, *, robot=None, service=None, connect=True, **options):
        clock = options.get("service_clock", (0.0, 0.0))
        robot = robot or {}
        service = service or {}
        link = LossyLink(
            self.session(Role.ROBOT, **robot), self.session(Role.SERVICE, now=clock[0], **service), **options
        )
        if connect:
            link.run(1.0)
            assert link.events[Role.ROBOT], "the handshake failed"
            assert link.events[Role.SERVICE], "the handshake failed"
        return link


@pytest.fixture
def world():
    return World()


@pytest.fixture(scope="session")
def make_world():
    return World


@pytest.fixture(scope="session")
def topics():
    return TOPICS


@pytest.fixture
def fast():
    """Without pacing: everything is sent at once."""
    return Config(rate_bps=1e12, burst=64_000)
