import threading
import time
from dataclasses import replace
from math import isnan

import pytest

from skytether.api.manifest import Needs as ServiceNeeds
from skytether.api.manifest import TopicSpec
from skytether.api.rest import Session, State, TopicReport
from skytether.bridge import BridgeError, topics_from_api
from skytether.messages import WrenchStamped, type_hash
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig
from skytether.robot.control.arbiter import Reason
from skytether.robot.control.command import Source
from skytether.robot.control.fallback import FallbackError
from skytether.wire.events import Connected, Refused
from skytether.wire.stats import PathStats, SessionStats, TopicStats
from skytether.wire.topic import Role

SESSION = Session(
    id="00000000000000ab",
    key="MDEyMzQ1Njc4OTAxMjM0NTY3ODkwMTIzNDU2Nzg5MDE=",
    host="10.0.0.1",
    port=4000,
    topics=(
        TopicSpec(name="force", type="geometry_msgs/msg/WrenchStamped", direction="in", priority=120),
        TopicSpec(name="wheels", type="sensor_msgs/msg/JointState", direction="in"),
        TopicSpec(name="cmd_vel", type="geometry_msgs/msg/Twist", direction="out", priority=127),
    ),
    needs=ServiceNeeds(max_rtt_ms=600, max_loss=0.2),
)
CONFIG = AgentConfig(
    robot="walker", url="https://nowhere", token="secret-token", service="virtual-trail", fallback="admittance"
)


class Rig:
    """An agent whose threads do not run, a made-up clock, and the bridges that it made."""

    def __init__(self, base, orchestrator, make_bridge, config=CONFIG, graph=None):
        self.now = 50.0
        self.made = []

        def bridge(spec, port, bind, peer):
            endpoint = make_bridge()
            self.made.append((spec, port, bind, peer, endpoint))
            return endpoint

        self.agent = Agent(config, base, graph=graph, client=orchestrator, bridge=bridge, clock=lambda: self.now)

    def tick(self):
        self.now += 0.01
        self.agent.tick(self.now)

    def ask(self):
        """One exchange, and what the control loop and the watch do of it."""
        self.agent.ask()
        self.tick()
        self.agent.watch(self.now)

    @property
    def bridges(self):
        return [endpoint for *_, endpoint in self.made]

    @property
    def session(self):
        """The robot's side of the bridge that was made last."""
        return self.made[-1][1]


@pytest.fixture
def rig(base, orchestrator, make_bridge):
    orchestrator.session = SESSION
    return Rig(base, orchestrator, make_bridge)


def test_a_session_is_opened_with_the_topics_that_both_have(rig):
    rig.ask()
    spec, _, bind, peer, endpoint = rig.made[0]
    assert (spec.id, spec.key, spec.role) == (0xAB, b"01234567890123456789012345678901", Role.ROBOT)
    assert {topic.name: topic.type_hash for topic in spec.topics} == {
        "force": type_hash(WrenchStamped, "cdr"),
        "cmd_vel": "",
    }
    assert (bind, peer) == (("0.0.0.0", 0), ("10.0.0.1", 4000))
    assert endpoint.running
    rig.ask()
    assert len(rig.made) == 1
    assert endpoint.peers == []


def test_an_instance_without_an_address_is_waited_for(rig, orchestrator):
    orchestrator.session = SESSION.model_copy(update={"port": None})
    rig.ask()
    assert rig.made == []


def test_the_bridge_follows_a_service_that_came_back_elsewhere(rig, orchestrator):
    rig.ask()
    orchestrator.session = SESSION.model_copy(update={"port": 4001})
    rig.ask()
    assert len(rig.made) == 1
    assert rig.bridges[0].peers == [("10.0.0.1", 4001)]


def test_only_a_twist_may_drive(rig, orchestrator):
    wrench = SESSION.topics[2].model_copy(update={"type": "geometry_msgs/msg/Wrench"})  # decodes as a Twist
    orchestrator.session = SESSION.model_copy(update={"topics": (*SESSION.topics[:2], wrench)})
    rig.ask()
    assert rig.made == []
    assert "only a geometry_msgs/msg/Twist may drive" in rig.agent.status().trouble


def test_an_experiment_may_put_a_link_in_between(base, orchestrator, make_bridge):
    orchestrator.session = SESSION
    rig = Rig(base, orchestrator, make_bridge, replace(CONFIG, route=lambda host, port: ("127.0.0.1", port + 1)))
    rig.ask()
    assert rig.made[0][3] == ("127.0.0.1", 4001)
    orchestrator.session = SESSION.model_copy(update={"port": 5000})
    rig.ask()
    assert rig.bridges[0].peers == [("127.0.0.1", 5001)]


def test_a_new_session_replaces_the_old_one(rig, orchestrator, make_cloud):
    rig.ask()
    make_cloud(rig.session)
    rig.bridges[0].snapshot = SessionStats(True, (), (PathStats(0, None, rtt=0.7),))
    rig.agent.watch(rig.now)
    assert rig.agent.status().rtt == 0.7
    orchestrator.session = SESSION.model_copy(update={"id": "00000000000000cd"})
    rig.ask()
    assert [endpoint.running for endpoint in rig.bridges] == [False, True]
    assert not rig.agent.status().connected
    assert isnan(rig.agent.status().rtt), "of the session before"
    cloud = make_cloud(rig.session)
    assert rig.agent.status().connected
    cloud.send(rig.now)
    rig.agent.tick(rig.now)
    assert rig.agent.status().driver.first_command_at == rig.now


def test_while_the_cloud_drives_another_session_takes_over_with_its_first_command(rig, orchestrator, make_cloud):
    rig.ask()
    before = make_cloud(rig.session)
    while rig.agent.source is not Source.CLOUD:
        before.send(rig.now)
        rig.tick()
    orchestrator.session = SESSION.model_copy(update={"id": "00000000000000cd"})
    rig.ask()
    for _ in range(20):  # the other one is joined, and has not commanded yet
        before.send(rig.now)
        rig.tick()
        rig.agent.watch(rig.now)
    assert rig.agent.source is Source.CLOUD
    assert [endpoint.running for endpoint in rig.bridges] == [True, True]
    assert rig.bridges[0].published[-1] == rig.bridges[1].published[-1], "both get the readings"
    after = make_cloud(rig.session)
    after.send(rig.now)
    rig.tick()
    assert rig.agent.source is Source.CLOUD
    rig.agent.watch(rig.now)
    assert [endpoint.running for endpoint in rig.bridges] == [False, True]
    assert len(rig.agent.status().driver.transitions) == 2  # the start, and the cloud: no hand-over in between


class OneAtATime:
    """A graph whose topics go to the session that was opened last."""

    encoding = "cdr"

    def __init__(self):
        self.opened = 0

    def open(self, specs, _command_topic):
        self.opened += 1
        return topics_from_api(specs), self

    def attach(self, publisher):
        pass

    def deliver(self, message):
        pass

    def notify(self, event):
        pass


def test_on_a_graph_the_session_that_is_kept_after_all_is_joined_anew(base, orchestrator, make_bridge, make_cloud):
    orchestrator.session = SESSION
    rig = Rig(base, orchestrator, make_bridge, graph=(graph := OneAtATime()))

    def drive():
        cloud = make_cloud(rig.session)
        for _ in range(500):
            cloud.send(rig.now)
            rig.tick()
        assert rig.agent.source is Source.CLOUD

    rig.ask()
    drive()
    other = SESSION.model_copy(update={"id": "00000000000000cd"})
    orchestrator.successor = "i2"
    orchestrator.changes["i2"] = {"session": other, "successor": None}
    while graph.opened < 2:
        rig.ask()
    assert [endpoint.running for endpoint in rig.bridges] == [True, True]
    orchestrator.changes["i2"]["state"] = State.FAILED  # it never commanded
    rig.ask()
    assert [endpoint.running for endpoint in rig.bridges] == [False, False]
    assert rig.agent.source is Source.FALLBACK
    orchestrator.successor = None
    rig.ask()
    assert (rig.made[-1][0].id, graph.opened) == (rig.made[0][0].id, 3)
    assert rig.bridges[-1].running
    drive()


def test_a_bridge_that_cannot_be_opened_is_said_once_and_tried_again(rig, monkeypatch, caplog, make_bridge):
    def taken(self):
        raise BridgeError("the port is taken")

    with monkeypatch.context() as patch:
        patch.setattr(make_bridge, "start", taken)
        rig.ask()
        rig.ask()
        sentence = "no bridge to 10.0.0.1:4000: the port is taken"
        assert rig.agent.status().trouble == sentence
        assert caplog.messages == [sentence]
    rig.ask()
    assert rig.agent.status().trouble == ""
    assert rig.bridges[-1].running


def test_the_bridges_counters_feed_choice_and_report(rig):
    rig.ask()
    topic = TopicStats("cmd_vel", "out", 127, sent=100, delivered=70, lost=30, delay_p50=0.05, bytes_sent=8000)
    rig.bridges[0].snapshot = SessionStats(True, (topic,), (PathStats(0, None, rtt=0.1),))
    rig.agent.watch(rig.now)
    rig.bridges[0].snapshot = SessionStats(
        True, (replace(topic, sent=200, delivered=140, lost=60),), (PathStats(0, None, rtt=0.12),)
    )
    rig.agent.watch(rig.now + 1)
    status = rig.agent.status()
    assert (status.rtt, status.loss) == (0.12, pytest.approx(0.3))
    report = rig.agent.report()
    assert (report.rtt_s, report.control_source, report.fallback_transitions) == (0.12, "fallback", {"start": 1})
    assert report.topics == (
        TopicReport(
            topic="cmd_vel",
            direction="out",
            priority=127,
            sent=200,
            delivered=140,
            lost=60,
            bytes_sent=8000,
            delay_p50_s=0.05,
        ),
    )


def test_what_the_service_needs_of_the_link_is_taken_over(rig, make_cloud):
    rig.ask()
    cloud = make_cloud(rig.session)
    rig.bridges[0].snapshot = SessionStats(True, (), (PathStats(0, None, rtt=0.7),))
    for _ in range(200):
        rig.now += 0.01
        cloud.send(rig.now)
        rig.agent.tick(rig.now)
    assert rig.agent.status().driver.source is Source.CLOUD
    rig.agent.watch(rig.now)
    for _ in range(60):
        rig.now += 0.01
        cloud.send(rig.now)
        rig.agent.tick(rig.now)
    assert rig.agent.status().driver.transitions[-1].reason is Reason.RTT


def test_an_answer_of_the_orchestrator_widens_no_limit_of_the_robot(rig, orchestrator, make_cloud):
    """The same link as above is too slow by the robot's own needs, whatever the session says that the service bears."""
    needs = SESSION.needs.model_copy(update={"max_rtt_ms": 1e9, "max_loss": 1.0})
    orchestrator.session = SESSION.model_copy(update={"needs": needs})
    rig.ask()
    cloud = make_cloud(rig.session)
    rig.bridges[0].snapshot = SessionStats(True, (), (PathStats(0, None, rtt=1.2),))
    for _ in range(200):
        rig.now += 0.01
        cloud.send(rig.now)
        rig.agent.tick(rig.now)
    assert rig.agent.status().driver.source is Source.CLOUD
    rig.agent.watch(rig.now)
    for _ in range(60):
        rig.now += 0.01
        cloud.send(rig.now)
        rig.agent.tick(rig.now)
    assert rig.agent.status().driver.transitions[-1].reason is Reason.RTT
    assert rig.agent.status().driver.why == "round trip 1200 ms, 1000 ms at most"


def test_a_service_that_sends_ten_times_as_often_is_named_once_and_its_newest_followed(
    rig, orchestrator, make_cloud, caplog
):
    rows = [t.model_copy(update={"period_ms": 10}) if t.name == "cmd_vel" else t for t in SESSION.topics]
    orchestrator.session = SESSION.model_copy(update={"topics": tuple(rows)})
    rig.ask()
    cloud, sent = make_cloud(rig.session), 0
    for _ in range(500):
        rig.now += 0.01
        for i in range(10):
            cloud.send(rig.now, linear=0.02 * i)
        sent += 10
        rig.agent.tick(rig.now)
        topic = TopicStats("cmd_vel", "out", 127, sent=sent, delivered=sent)
        rig.bridges[0].snapshot = SessionStats(True, (topic,))
        rig.agent.watch(rig.now)
    assert rig.agent.status().driver.velocity.linear == pytest.approx(0.18)
    named = [message for message in caplog.messages if "times a second" in message]
    assert len(named) == 1
    assert "sends cmd_vel 1000 times a second, its manifest says 100" in named[0]


def test_a_session_that_the_service_refuses_is_told(rig):
    rig.ask()
    rig.session.notify(Refused("topic force: types differ"))
    assert rig.agent.status().trouble == "the service refused the session: topic force: types differ"
    rig.session.notify(Connected(()))
    assert rig.agent.status().trouble == ""


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_control_loop_that_dies_leaves_the_wheels_standing(base, orchestrator):
    def die():
        if len(base.written) == 20:
            raise SystemExit

    base.on_read = die
    with Agent(CONFIG, base, client=orchestrator):
        (loop,) = (thread for thread in threading.enumerate() if thread.name == "agent_control")
        loop.join(30)
        assert len(base.written) == 21
        assert base.written[-2][0] > 0
        assert base.velocity == (0.0, 0.0)


def test_closing_stands_the_wheels_whatever_the_loop_does(rig, base):
    for _ in range(50):
        rig.now += 0.01
        rig.agent.tick(rig.now)
    assert base.velocity[0] > 0
    rig.agent.close()
    assert base.velocity == (0.0, 0.0)


def test_nothing_shows_the_token():
    assert "secret-token" not in repr(CONFIG)


def test_a_fallback_that_cannot_be_had_is_told_before_anything_runs(base, orchestrator):
    with pytest.raises(FallbackError, match="no fallback 'levitate'"):
        Agent(replace(CONFIG, fallback="levitate"), base, client=orchestrator)


@pytest.mark.slow
def test_the_loop_keeps_its_rate_while_the_orchestrator_blocks_and_the_wheels_stand_last(
    base, orchestrator, make_bridge
):
    orchestrator.session = SESSION
    answering, blocked, go = orchestrator.renew_instance, threading.Event(), threading.Event()

    def block(instance_id, renew):
        blocked.set()
        go.wait(5)
        return answering(instance_id, renew)

    orchestrator.renew_instance = block
    made = []

    def bridge(spec, port, bind, peer):
        made.append(make_bridge())
        port.notify(Connected(spec.topics))
        return made[-1]

    with Agent(replace(CONFIG, renew_s=0.01), base, client=orchestrator, bridge=bridge) as agent:
        assert blocked.wait(5)
        written, began = len(base.written), time.monotonic()
        time.sleep(0.5)
        ticks, elapsed = len(base.written) - written, time.monotonic() - began
        assert ticks + agent.status().overruns >= 0.9 * 100 * elapsed - 1
        assert base.written[-1][0] > 0
        go.set()
    assert base.written[-1] == (0.0, 0.0)
    assert orchestrator.calls[-1] == ("delete", "i1")
    assert [endpoint.running for endpoint in made] == [False]
    assert made[0].published
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("agent")]
