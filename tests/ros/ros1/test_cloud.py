"""What a service may do on a real ROS 1 graph: one that publishes joystick, laser, button and velocities of its own."""

import subprocess
import time
from pathlib import Path

import pytest
import yaml
from ros1_graph import wait_for
from ros1_pair import Pair

from skytether.api.client import Client
from skytether.api.manifest import Manifest, TopicSpec
from skytether.api.rest import RobotCreate, SiteCreate
from skytether.bridge.calls import CallError
from skytether.lab.embedded import EmbeddedOrchestrator
from skytether.messages import Bool, Joy, LaserScan, Twist, decode, encode, hash_of
from skytether.robot.safety.client import GateError, ask
from skytether.ros import permissions
from skytether.ros.permissions import Allowed
from skytether.ros.ros1.node import Node
from skytether.ros.ros1.services import ServiceType
from skytether.ros.ros1.subscription import Listener

pytestmark = [pytest.mark.ros1, pytest.mark.slow]

ROOT = Path(__file__).parents[3]
TRIGGER = "std_srvs/srv/Trigger"
STOLEN = {
    "/cmd_vel": Twist.TYPE,
    "/cmd_vel_safe": Twist.TYPE,
    "/joy": Joy.TYPE,
    "/scan": LaserScan.TYPE,
    "/estop": Bool.TYPE,
}


def row(name, typ=Twist.TYPE, direction="out", **more):
    return {"name": name, "type": typ, "direction": direction, **more}


def manifest(*rows):
    return Manifest.model_validate(
        {
            "apiVersion": "skytether.io/v1",
            "kind": "Service",
            "metadata": {"name": "attack"},
            "spec": {"entrypoint": "cloud_attack", "topics": [row("cmd_vel"), row("own"), *rows]},
        }
    )


@pytest.fixture
def cloud(tmp_path):
    """An orchestrator that runs the attack, and a robot.yaml that asks for it."""
    (tmp_path / "orchestrator").mkdir()
    with (
        EmbeddedOrchestrator(tmp_path / "orchestrator") as orchestrator,
        Client(orchestrator.url, orchestrator.operator_token) as client,
    ):
        options = {"python_path": [str(ROOT / folder) for folder in ("platform", "tests/support")]}
        client.create_site(SiteCreate(name="here", tier="edge", runtime="process", options=options))
        client.delete_site("local")
        client.put_service("attack", manifest(*(row(name, kind) for name, kind in STOLEN.items())))
        token = tmp_path / "walker.token"
        token.touch(0o600)
        token.write_text(client.create_robot(RobotCreate(name="walker")).token)
        orchestrator.client = client
        yield orchestrator


@pytest.fixture
def robot(graph, cloud, tmp_path):
    """Writes robot.yaml."""

    def write(**more):
        document = {
            "robot": "walker",
            "orchestrator": cloud.url,
            "token_file": "walker.token",
            "service": "attack",
            "limits": {"max_gap_s": 1.0},
            "status_port": None,
            "ros1": {"master": graph.uri, "namespace": "/", "cmd_vel": "/cmd_vel_safe"},
            "safety": {
                "footprint": {"radius": 0.3},
                "sensors": {"/scan": {"max_age_s": 1.0}},
                "joystick": {"topic": "/joy", "deadman": 0},
                "estop": {"topic": "/estop", "max_age_s": None},
                "guard_s": 0.5,
                "folder": str(tmp_path / "gate"),
            },
            **more,
        }
        path = tmp_path / "robot.yaml"
        path.write_text(yaml.safe_dump({key: value for key, value in document.items() if value is not None}))
        return path

    return write


@pytest.fixture
def wheels(graph):
    """What the wheels' topics carry, by topic: velocities, from whomever."""
    told = {"/cmd_vel": [], "/cmd_vel_safe": []}
    with Node("base", graph.uri, look_s=0.2) as node:
        for topic, kept in told.items():
            node.subscribe(
                topic, "*", "", Listener(lambda data, _, kept=kept: kept.append(decode(Twist, data, "ros1").linear.x))
            )
        yield told


def start(graph, tmp_path, *arguments):
    said = (tmp_path / f"{arguments[1]}.log").open("wb")
    process = graph.skytether(*arguments, stdout=said, stderr=said)
    said.close()
    return process, tmp_path / f"{arguments[1]}.log"


@pytest.mark.parametrize("listed", [None, {"publish": ["/"], "call": ["/"], "offer": ["/"]}])
def test_a_service_that_wants_the_joystick_or_the_wheels_gets_no_session(graph, robot, wheels, tmp_path, listed):
    """With the emergency stop latched too: nothing but the gate's standstill ever reaches the wheels."""
    config = str(robot(cloud=listed))
    _, gate_log = start(graph, tmp_path, "robot", "gate", config)
    folder = tmp_path / "gate"

    def stopped() -> bool:
        try:
            return bool(ask(folder, {"do": "stop", "reason": "test"}, 30))
        except GateError:
            return False

    wait_for(stopped, "the gate")
    checked = graph.skytether("robot", "run", config, "--check", stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    found, said = (text.decode() for text in checked.communicate(timeout=60))
    assert checked.returncode == 1, found + said
    agent, log = start(graph, tmp_path, "robot", "run", config)
    wait_for(lambda: "the service's '/joy'" in log.read_text(), "the refusal")
    time.sleep(2.0)  # it may try again
    for name in STOLEN:
        # The wheels listen to /cmd_vel_safe; /cmd_vel is somebody else's, and may be listed.
        assert (f"{name} is never published" in log.read_text()) == (name != "/cmd_vel")
        assert "/skytether" not in graph.publishers(name)
    assert ("cloud: {publish: [/cmd_vel]}" in log.read_text()) == (listed is None)
    assert set(wheels["/cmd_vel_safe"]) == {0.0}
    assert wheels["/cmd_vel"] == []
    assert ask(folder, {"do": "status"}, 30)["hand"] != "joystick"
    graph.end(agent)
    assert "Traceback" not in log.read_text() + gate_log.read_text()


def test_without_a_gate_the_wheels_and_the_readings_are_kept_too(graph, robot, cloud, wheels, tmp_path):
    cloud.client.put_service("attack", manifest(row("/cmd_vel_safe"), row("/joy", Joy.TYPE)))
    graph_section = {"master": graph.uri, "namespace": "/", "cmd_vel": "/cmd_vel_safe", "readings": {"joy": Joy.TYPE}}
    agent, log = start(graph, tmp_path, "robot", "run", str(robot(safety="none", ros1=graph_section)))
    wait_for(lambda: "the service's '/joy'" in log.read_text(), "the refusal")
    assert "/cmd_vel_safe is never published" in log.read_text()
    wait_for(lambda: wheels["/cmd_vel_safe"], "the agent's standstill")
    time.sleep(1.0)
    assert set(wheels["/cmd_vel_safe"]) == {0.0}
    graph.end(agent)


def test_a_name_is_given_by_the_list_and_by_nothing_else(graph, robot, cloud, wheels, tmp_path):
    """Its own namespace is the service's; /cmd_vel, to which nobody of safety listens here, is by the list."""
    heard = []
    with Node("ear", graph.uri, look_s=0.2) as node:
        node.subscribe("/attack/own", "*", "", Listener(lambda data, _: heard.append(data)))
        cloud.client.put_service("attack", manifest(row("/cmd_vel")))
        agent, log = start(graph, tmp_path, "robot", "run", str(robot()))
        wait_for(lambda: "is written there: cloud: {publish: [/cmd_vel]}" in log.read_text(), "what to write")
        graph.end(agent)
        assert (heard, wheels["/cmd_vel"]) == ([], [])
        agent, log = start(graph, tmp_path, "robot", "run", str(robot(cloud={"publish": ["cmd_vel"]})))
        wait_for(lambda: heard and 5.0 in wheels["/cmd_vel"], "what is allowed")
        graph.end(agent)


@pytest.fixture
def unchecked(make_graph, monkeypatch):
    """A session whose table has everything, as if nothing had been looked at when it began."""
    monkeypatch.setattr(permissions, "check", lambda *_: None)
    made = []

    def make(*specs, **config):
        robot, service = make_graph("robot").start_master(), make_graph("service").start_master()
        allowed = Allowed(*(["/"],) * 3)
        made.append(
            Pair(robot, service, specs, config={"namespace": "/", "allowed": allowed, **config}),
        )
        return made[-1], robot

    yield make
    for pair in made:
        pair.close()


def test_at_delivery_the_names_are_looked_at_again(unchecked):
    """Topics, an action's, calls both ways; and parameters, of which a service can set none."""
    kept = dict.fromkeys(("/joy", "/scan", "/stop", "/dock/goal", "/dock/result", "/halt", "/power"), "safety's")
    specs = [
        *(TopicSpec(**row(name, Joy.TYPE, reliable=True)) for name in ("/joy", "/scan", "/free")),
        TopicSpec(**row("stolen", Joy.TYPE)),
        TopicSpec(**row("/dock", "my_msgs/action/Dock", kind="action")),
        TopicSpec(**row("/halt", TRIGGER, kind="call")),
        TopicSpec(**row("/power", TRIGGER, "in", kind="call")),
        TopicSpec(**row("/open", TRIGGER, kind="call")),
    ]
    pair, robot = unchecked(*specs, protected=kept, remap={"stolen": "/stop"})
    called = []
    trigger = ServiceType("std_srvs/Trigger", hash_of(TRIGGER, "ros1"))
    with Node("safety", robot.uri, look_s=0.2) as node:
        heard = {name: [] for name in (*kept, "/free")}
        for name, messages in heard.items():
            node.subscribe(name, "*", "", Listener(lambda data, _, kept=messages: kept.append(data)))
        for name in ("/halt", "/open"):
            node.serve(name, trigger, lambda request, name=name: called.append(name) or b"\x01\0\0\0\0")
        pair.service.publish("skytether/graph/service", b'{"params": {"/stolen": 1, "/use_sim_time": true}}')
        message = encode(Joy(), "ros1")

        def publish() -> bool:
            for topic in pair.service.stats().topics:
                if topic.direction == "out" and topic.topic != "skytether/graph/service":
                    pair.service.publish(topic.topic, message)
            return bool(heard["/free"])

        wait_for(publish, "what is nobody's")
        wait_for(lambda: "/open" in called or pair.service.call("/open", b"", 5.0), "the call that is allowed")
        with pytest.raises(CallError, match="/halt is not called"):
            pair.service.call("/halt", b"", 5.0)
        state = {name: nodes for part in robot.call("getSystemState")[::2] for name, nodes in part}
        for name in kept:
            assert heard.get(name, []) == [], name
            assert "/skytether" not in state.get(name, []), name
        assert "/skytether" in state["/free"]
        assert called
        assert set(called) == {"/open"}
        assert not set(robot.call("getParamNames")) & {"/stolen", "/use_sim_time"}
