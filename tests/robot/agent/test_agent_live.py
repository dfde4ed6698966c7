"""The agent with real bridges on loopback, in real time; the service's end is a thread that sends commands."""

import socket
import threading
import time

import pytest

from skytether.api.manifest import Needs, TopicSpec
from skytether.api.rest import Session
from skytether.bridge import Bridge, SessionSpec
from skytether.messages import Twist, Vector3, WrenchStamped, decode, encode
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig
from skytether.robot.control.arbiter import Reason
from skytether.robot.control.command import Source
from skytether.wire.topic import Role

pytestmark = pytest.mark.slow

KEY = "MDEyMzQ1Njc4OTAxMjM0NTY3ODkwMTIzNDU2Nzg5MDE="
ID = "00000000000000ab"
TOPICS = (
    TopicSpec(
        name="force", type="geometry_msgs/msg/WrenchStamped", direction="in", priority=120, period_ms=10, lifespan_ms=50
    ),
    TopicSpec(name="cmd_vel", type="geometry_msgs/msg/Twist", direction="out", priority=127, period_ms=10),
)


class FastService:
    """The service's end: commands 0.2 m/s at 100 Hz while it is told to."""

    def __init__(self) -> None:
        self.forces = []
        self.sending = threading.Event()
        self.sending.set()
        self._ended = threading.Event()
        self.bridge = Bridge(SessionSpec.from_api(Role.SERVICE, ID, KEY, TOPICS), self)
        self.bridge.start()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def attach(self, publisher):
        pass

    def deliver(self, message):
        self.forces.append(decode(WrenchStamped, message.payload).wrench.force.x)

    def notify(self, event):
        pass

    def _run(self):
        while not self._ended.wait(0.01):
            if self.sending.is_set():
                self.bridge.publish("cmd_vel", encode(Twist(linear=Vector3(x=0.2))))

    def close(self):
        self._ended.set()
        self._thread.join()
        self.bridge.stop()


@pytest.fixture
def service():
    service = FastService()
    yield service
    service.close()


def wait_for(condition, seconds=5.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not come to that in time"
        time.sleep(0.005)


def test_the_cloud_drives_and_silence_hands_over_within_300_ms_and_back(base, orchestrator, service):
    host, port = service.bridge.address
    orchestrator.session = Session(
        id=ID, key=KEY, host=host, port=port, topics=TOPICS, needs=Needs(max_rtt_ms=600, max_loss=0.2)
    )
    config = AgentConfig(
        robot="walker", url="", token="", service="x", fallback="admittance", bind=("127.0.0.1", 0), renew_s=0.2
    )
    with Agent(config, base, client=orchestrator) as agent:

        def source():
            return agent.status().driver.source

        wait_for(lambda: source() is Source.CLOUD)
        wait_for(lambda: abs(base.velocity[0] - 0.2) < 1e-9)
        assert service.forces[-1] == 12.0
        status = agent.status()
        first, asked = status.driver.first_command_at, status.asked_at
        assert first is not None
        assert asked is not None
        assert first - asked < 1.0
        wait_for(lambda: agent.status().rtt < 0.1)

        service.sending.clear()
        silent = time.monotonic()
        wait_for(lambda: source() is Source.FALLBACK)
        last = agent.status().driver.transitions[-1]
        assert last.reason is Reason.NO_COMMAND
        assert last.at - silent < 0.3

        service.sending.set()
        wait_for(lambda: source() is Source.CLOUD)
        report = agent.report()
        assert report.fallback_transitions == {"start": 1, "recovered": 2, "no_command": 1}
        assert {topic.topic for topic in report.topics} == {"force", "cmd_vel"}
    assert base.velocity == (0.0, 0.0)


def test_who_is_told_to_end_while_it_starts_leaves_nothing_that_drives(base, orchestrator, monkeypatch):
    start = threading.Thread.start

    def told_to_end(thread):
        if thread.name == "agent_watch":
            wait_for(lambda: base.written and base.velocity[0] > 0.0)
            raise KeyboardInterrupt
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", told_to_end)
    config = AgentConfig(robot="walker", url="", token="", service="x", fallback="admittance", bind=("127.0.0.1", 0))
    with pytest.raises(KeyboardInterrupt), Agent(config, base, client=orchestrator):
        pass
    assert base.velocity == (0.0, 0.0)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("agent_")]


def test_a_name_server_that_never_answers_delays_no_hand_over(base, orchestrator, service, monkeypatch):
    """The service is said to have moved to a host that has to be asked for; the name server is dead meanwhile."""
    host, port = service.bridge.address
    there = Session(id=ID, key=KEY, host=host, port=port, topics=TOPICS, needs=Needs(max_rtt_ms=600, max_loss=0.2))
    elsewhere = there.model_copy(update={"host": "service.example"})
    asked, dead = threading.Event(), threading.Event()
    real = socket.getaddrinfo

    def ask(name, *arguments, **more):
        if name == "service.example" and not more.get("flags", 0) & socket.AI_NUMERICHOST:
            asked.set()
            dead.wait(60)
        return real(name, *arguments, **more)

    monkeypatch.setattr(socket, "getaddrinfo", ask)
    config = AgentConfig(
        robot="walker", url="", token="", service="x", fallback="admittance", bind=("127.0.0.1", 0), renew_s=0.2
    )
    orchestrator.session = there
    with Agent(config, base, client=orchestrator) as agent:
        wait_for(lambda: agent.source is Source.CLOUD)
        orchestrator.session = elsewhere
        assert asked.wait(30)
        service.sending.clear()
        silent = time.monotonic()
        wait_for(lambda: agent.source is Source.FALLBACK)
        assert agent.status().driver.transitions[-1].at - silent < 0.3
        service.sending.set()
        wait_for(lambda: agent.source is Source.CLOUD)
        wait_for(lambda: "service.example: the name server does not answer" in agent.status().trouble)
        begin, renewals = time.monotonic(), sum(name == "renew" for name, _ in orchestrator.calls)
        wait_for(lambda: sum(name == "renew" for name, _ in orchestrator.calls) > renewals + 2, 30)
        assert time.monotonic() - begin < 15, "the lease is kept"
        wait_for(lambda: agent.source is Source.CLOUD)
        dead.set()
