"""Two ends of a session on the loopback interface, with ports that write down what they are told."""

import time

import pytest
from recording_port import RecordingPort

from skytether.bridge import Bridge, SessionSpec
from skytether.wire.topic import Direction, Role, Topic

KEY = bytes(range(32))
TOPICS = (
    Topic("force", "t/msg/F", Direction.IN, priority=120, depth=10_000, lifespan=5.0, delivery=0.999),
    Topic("camera", "t/msg/C", Direction.IN, priority=10, depth=10_000, lifespan=5.0, delivery=0.99),
    Topic("cmd_vel", "t/msg/V", Direction.OUT, priority=127, depth=10_000, lifespan=5.0, delivery=0.9999),
)


class End(Bridge):
    """A bridge whose graph and session a test may look at."""

    def __init__(self, spec, port, **options):
        super().__init__(spec, port, **options)
        self.graph, self.spec = port, spec


class Ends:
    """Makes ends and stops what it made."""

    topics = TOPICS
    """Of an end that is made without others."""

    def __init__(self):
        self.made = []

    def make(self, role, port=None, *, topics=TOPICS, key=KEY, session_id=7, **options):
        """A bridge that is not started yet; its port is its attribute `graph`, its session `spec`."""
        port = port or RecordingPort()
        spec = SessionSpec(session_id, key, role, topics)
        bridge = End(spec, port, **options)
        self.made.append(bridge)
        return bridge

    def start(self, role, port=None, **options):
        bridge = self.make(role, port, **options)
        bridge.start()
        return bridge

    def pair(self, *, link=None, **options):
        """Service and robot, connected; `link` makes something in between from the service's address."""
        service = self.start(Role.SERVICE, **options)
        peer = link(service.address) if link else service.address
        robot = self.start(Role.ROBOT, peer=peer, **options)
        robot.graph.wait_connected()
        service.graph.wait_connected()
        return service, robot


@pytest.fixture
def ends():
    made = Ends()
    yield made
    for bridge in made.made:
        bridge.stop()


@pytest.fixture
def wait_for():
    """Polls what cannot be waited for."""

    def wait(condition, seconds=5):
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, "waited in vain"
            time.sleep(0.002)

    return wait
