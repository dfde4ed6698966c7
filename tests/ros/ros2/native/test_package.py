"""The package folder for ROS 2 users: installed as colcon does it, its nodes started as ``ros2 launch`` does it.

``launch`` itself cannot be had from PyPI: that its three files say the same, and what exists, is all that is looked at.
"""

import json
import os
import shlex
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml
from ros2_nodes import ros2_nodes, until

from skytether.api.client import Client
from skytether.api.manifest import Manifest
from skytether.api.rest import RobotCreate
from skytether.lab.embedded import EmbeddedOrchestrator
from skytether.ros.ros1.arguments import parse

__all__ = ["ros2_nodes"]

ROOT = Path(__file__).parents[4]
PACKAGE = ROOT / "ros2" / "skytether"
ROBOT = {
    "robot": "walker",
    "orchestrator": "http://127.0.0.1:9",
    "token_file": "walker.token",
    "service": "virtual-trail",
    "safety": "none",
    "status_port": None,
    "ros2": {},
}
GONE = object()
"""Value of a key that is not written."""
LISTENER = """
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Log
from rcl_interfaces.srv import DescribeParameters, GetParameters

def heard(message):
    for status in message.status:
        values = {pair.key: pair.value for pair in status.values}
        say(["status", status.name, int.from_bytes(status.level, "little"), status.message, values])
node.create_subscription(DiagnosticArray, "/diagnostics", heard, 100)
def logged(message):
    say(["log", message.name, message.level, message.msg])
node.create_subscription(Log, "/rosout", logged, qos(latched=True, depth=1000))

def nodes():
    found = node.get_node_names_and_namespaces()
    told = sorted(f"{namespace.rstrip('/')}/{name}" for name, namespace in found)
    say(["nodes", told, sorted(i.node_name for i in node.get_publishers_info_by_topic("/base/cmd_vel"))])

def ask(kind, name, request):
    client = node.create_client(kind, name)
    assert client.wait_for_service(20.0)
    return client.call(request)

def work():
    for line in sys.stdin:
        if line == "nodes\\n":
            nodes()
            continue
        asked, *names = line.split()
        described = ask(DescribeParameters, asked + "/describe_parameters", DescribeParameters.Request(names=names))
        values = ask(GetParameters, asked + "/get_parameters", GetParameters.Request(names=names)).values
        for d, value in zip(described.descriptors, values):
            limits = [[r.from_value, r.to_value] for r in d.integer_range]
            plain = [value.string_value, value.integer_value, list(value.string_array_value), value.bool_value]
            say(["parameter", d.name, d.type, d.description, d.read_only, limits, plain])
threading.Thread(target=work, daemon=True).start()
"""


class Launched:
    """Starts programs of the package with the command line and environment that ``ros2 launch`` gives them."""

    def __init__(self, prefix, program, folder):
        self.prefix, self.folder = prefix, folder
        self.config = folder / "robot.yaml"
        self._started = []
        self._environment = {
            **os.environ,
            "PYTHONPATH": str(next(prefix.glob("lib/python3*/site-packages"))),
            "AMENT_PREFIX_PATH": str(prefix),
            "SKYTETHER": str(program),
            "SKYTETHER_GATE_FOLDER": str(folder / "gate"),
        }
        for name in ("SKYTETHER_ROS2_PYTHON", "SKYTETHER_ROBOT"):
            self._environment.pop(name, None)
        token = folder / "walker.token"
        token.touch(0o600)
        token.write_text("secret")
        self.write()

    def write(self, **changes):
        document = {key: value for key, value in (ROBOT | changes).items() if value is not GONE}
        self.config.write_text(yaml.safe_dump(document))

    def start(self, what, name, *words, **parameters):
        file = self.folder / f"launch_params_{len(self._started)}"
        file.write_text(yaml.dump({"/**": {"ros__parameters": {"config": str(self.config), **parameters}}}))
        given = ["--ros-args", "-r", f"__node:={name}", "-r", "__ns:=/fleet/one", "--params-file", str(file), *words]
        return self.run(what, *given)

    def run(self, what, *words, **environment):
        process = subprocess.Popen(
            [self.prefix / "lib" / "skytether" / what, *words],
            env={**self._environment, **environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._started.append(process)
        return process

    def close(self):
        for process in self._started:
            process.terminate()
            process.communicate()


@pytest.fixture(scope="module")
def prefix(ros2, tmp_path_factory):
    """The package, installed with the command that colcon has for ament_python."""
    folder = tmp_path_factory.mktemp("ament")
    prefix, source = folder / "install", folder / "build"
    subprocess.run(["cp", "-r", PACKAGE, source], check=True)
    command = ["setup.py", "-q", "install", "--prefix", prefix, "--single-version-externally-managed"]
    subprocess.run(
        [ros2, *command, "--record", folder / "files"], cwd=source, check=True, capture_output=True, timeout=120
    )
    return prefix


@pytest.fixture
def launched(prefix, ros2_nodes, tmp_path):
    program = tmp_path / "skytether"
    paths = os.pathsep.join(str(ROOT / folder) for folder in ("platform", "services"))
    program.write_text(
        f'#!/bin/sh\nexport PYTHONPATH="$PYTHONPATH:{paths}"\nexec {sys.executable} -m skytether.cli "$@"\n'
    )
    program.chmod(0o755)
    found = Launched(prefix, program, tmp_path)
    yield found
    found.close()


class Listener:
    """A node that hears the diagnostics and asks for what is wanted."""

    def __init__(self, node):
        self._node = node
        self.statuses = {}
        self.logs = []

    def status(self, name, wanted):
        """Wait for a status that is as wanted."""
        until(lambda: name in self.hear() and wanted(self.statuses[name]), f"{name} in {self.statuses}")
        return self.statuses[name]

    def hear(self):
        for what, *rest in self._node.all():
            if what == "status":
                self.statuses[rest[0]] = SimpleNamespace(level=rest[1], message=rest[2], values=rest[3])
            elif what == "log":
                self.logs.append(rest)
        return self.statuses

    def nodes(self):
        """Names of all nodes, and of those that publish the wheels' topic."""
        self._node.tell("nodes")
        return self._next("nodes")

    def parameters(self, node, *names):
        self._node.tell(" ".join([node, *names]))
        return {found[0]: found[1:] for found in (self._next("parameter") for _ in names)}

    def _next(self, what):
        while True:
            found = self._node.next()
            if found[0] == "log":
                self.logs.append(found[1:])
            if found[0] == what:
                return found[1:]


def programs(folder):
    """Command lines of what runs with the gate's folder of this test."""
    found = []
    for entry in Path("/proc").iterdir():
        with suppress(OSError):
            if f"SKYTETHER_GATE_FOLDER={folder}/gate".encode() in (entry / "environ").read_bytes().split(b"\0"):
                found.append((entry / "cmdline").read_bytes().replace(b"\0", b" ").decode())
    return found


def alive(process):
    return Path(f"/proc/{process}/exe").exists()


@pytest.mark.slow
@pytest.mark.ros2
def test_the_files_land_where_ament_looks_for_them(ros2, prefix):
    asked = (
        "import json; from catkin_pkg.package import parse_package; "
        "from ament_index_python.packages import get_package_share_directory as share; "
        "found = parse_package(share('skytether') + '/package.xml'); found.validate(); "
        "print(json.dumps([found.name, found.get_build_type(), [d.name for d in found.exec_depends]]))"
    )
    environment = {**os.environ, "AMENT_PREFIX_PATH": str(prefix)}
    answer = subprocess.run([ros2, "-c", asked], env=environment, capture_output=True, text=True, check=True)
    name, build_type, needs = json.loads(answer.stdout)
    assert (name, build_type) == ("skytether", "ament_python")
    assert {"rclpy", "launch_ros", "diagnostic_msgs"} <= set(needs)
    assert {file.name for file in (prefix / "share/skytether/launch").iterdir()} == {
        "robot.launch.py",
        "robot.launch.xml",
        "robot.launch.yaml",
    }
    assert {file.name for file in (prefix / "lib/skytether").iterdir()} == {"robot_run", "robot_gate"}
    # ROS has this folder on PYTHONPATH: there it must not stand before the platform.
    assert not list(prefix.glob("lib/python3*/site-packages/skytether[.-]*"))
    assert not list(prefix.glob("lib/python3*/site-packages/skytether"))


@pytest.mark.slow
@pytest.mark.ros2
def test_a_robot_is_where_launch_says_and_ends_when_it_is_told_to(launched, ros2_nodes):
    listener = Listener(ros2_nodes.start(LISTENER, "listener"))
    process = launched.start("robot_run", "mine", "-r", "cmd_vel:=/base/cmd_vel", service="recorder", status_port=0)
    runs = listener.status("fleet/one/mine: program", lambda status: status.level == 0)
    control = listener.status("fleet/one/skytether: control", lambda status: True)
    assert (control.level, control.message) == (2, "driven by stop: no command has come yet")
    assert listener.status("fleet/one/skytether: session", lambda status: True).message == "not connected"
    service = listener.status("fleet/one/skytether: service", lambda status: status.message)
    assert (service.level, service.values["asked for"]) == (1, "recorder")
    until(lambda: listener.hear() and any("no orchestrator answers" in log[2] for log in listener.logs), "the log")
    assert {log[:2] == ["fleet.one.skytether", 30] for log in listener.logs if "no orchestrator" in log[2]} == {True}
    nodes, drivers = listener.nodes()
    assert {"/fleet/one/mine", "/fleet/one/skytether"} <= set(nodes)
    assert drivers == ["skytether"]
    parameters = listener.parameters("/fleet/one/mine", "config", "service", "status_port")
    assert parameters["status_port"][2:] == [True, [[-1, 65535]], ["", 0, [], False]]
    assert parameters["config"][1].startswith("robot.yaml of this robot")
    assert parameters["config"][-1][0] == str(launched.config)
    assert parameters["service"][-1][0] == "recorder"
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGINT)  # launch's, beside the terminal's
    said, _ = process.communicate(timeout=30)
    assert process.returncode == 0, said
    assert not alive(runs.values["process"])
    # Whose last word is lost, or comes too late (`native.node.LEAVE_S`), DDS forgets after its lease of 20 s.
    until(lambda: listener.nodes() == [["/listener"], []], "both nodes to be gone", 60)


@pytest.mark.slow
@pytest.mark.ros2
def test_an_agent_that_dies_is_told_and_ends_the_node(launched, ros2_nodes):
    listener = Listener(ros2_nodes.start(LISTENER, "listener"))
    process = launched.start("robot_run", "mine")
    runs = listener.status("fleet/one/mine: program", lambda status: status.level == 0)
    listener.status("fleet/one/skytether: control", lambda status: True)
    os.kill(int(runs.values["process"]), signal.SIGKILL)
    said, _ = process.communicate(timeout=30)
    assert process.returncode == 128 + signal.SIGKILL
    assert "skytether robot run ended by SIGKILL" in said
    assert listener.status("fleet/one/mine: program", lambda s: s.level == 2).message == "ended by SIGKILL"


@pytest.mark.slow
@pytest.mark.ros2
def test_a_node_that_dies_ends_its_agent(launched, ros2_nodes):
    listener = Listener(ros2_nodes.start(LISTENER, "listener"))
    process = launched.start("robot_run", "mine")
    runs = listener.status("fleet/one/mine: program", lambda status: status.level == 0)
    listener.status("fleet/one/skytether: control", lambda status: True)
    process.kill()
    until(lambda: not alive(runs.values["process"]), "the agent to end")


@pytest.mark.slow
@pytest.mark.ros2
def test_gate_and_agent_are_nodes_of_one_namespace(launched, ros2_nodes):
    launched.write(safety=GONE, ros2={"namespace": "/elsewhere"})
    listener = Listener(ros2_nodes.start(LISTENER, "listener"))
    wheels = "cmd_vel:=/base/cmd_vel"
    gate = launched.start("robot_gate", "gate_launch", "-r", wheels, use_sim_time=True)
    listener.status("fleet/one/gate_launch: program", lambda status: status.level == 0)
    until(lambda: "skytether_gate" in listener.nodes()[1], "the gate to have the wheels")
    agent = launched.start("robot_run", "robot_launch", "-r", wheels, use_sim_time=True)
    listener.status("fleet/one/skytether: gate", lambda status: status.message != "does not answer")
    ours = [f"/fleet/one/skytether{role}" for role in ("", "_guard", "_gate")]
    # A node's name is discovered after what it publishes.
    until(lambda: set(ours) <= set(listener.nodes()[0]), "the three nodes")
    found = set(listener.nodes()[0])
    for node in ours:
        assert listener.parameters(node, "use_sim_time")["use_sim_time"][-1][-1] is True, node
    assert all(name.startswith("/fleet/one/") for name in found - {"/listener"})
    for process in (agent, gate):
        process.send_signal(signal.SIGTERM)
        said, _ = process.communicate(timeout=40)
        assert process.returncode == 0, said
    until(lambda: not programs(launched.folder), "all processes to be gone")


@pytest.mark.slow
@pytest.mark.ros2
@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"config": "/not/there.yaml"}, "error: there is no file '/not/there.yaml'; name this robot's robot.yaml"),
        ({"program": "not-there"}, "error: there is no program 'not-there'; install it with 'pip install skytether'"),
        ({"status_port": 70_000}, "status_port out of range. Min: -1, Max: 65535, value: 70000"),
        ({"service": 5}, "'service' to '5' of type 'INTEGER', expecting type 'STRING'"),
    ],
)
def test_a_start_that_cannot_work_is_one_sentence_and_status_2(launched, given, says):
    process = launched.start("robot_run", "mine", **given)
    said, _ = process.communicate(timeout=30)
    assert process.returncode == 2
    assert says in said
    assert len(said.splitlines()) == 1, said


@pytest.mark.slow
@pytest.mark.ros2
def test_what_is_wrong_with_the_file_is_the_agents_own_word_and_status(launched):
    launched.write(service="Not A Name")
    process = launched.start("robot_run", "mine")
    said, _ = process.communicate(timeout=30)
    assert process.returncode == 2
    assert "service" in said
    assert "skytether robot run ended with code 2" in said


def documented(beginning):
    """What a shell makes of the command line of docs/ros2.md that begins so, behind the program's name."""
    page = (ROOT / "docs" / "ros2.md").read_text().replace("\\\n", "")
    (line,) = [line for line in page.splitlines() if line.startswith(f"ros2 run skytether robot_run {beginning}")]
    return shlex.split(line, comments=True)[4:]


@pytest.mark.slow
@pytest.mark.ros2
def test_the_documented_command_line_gives_the_agent_what_it_says(launched, ros2_nodes):
    listener = Listener(ros2_nodes.start(LISTENER, "listener"))
    process = launched.run("robot_run", *documented("--ros-args"), SKYTETHER_ROBOT=str(launched.config))
    runs = listener.status("walker/skytether_launch: program", lambda status: status.level == 0)
    given = runs.values["command"].partition(" -- ")[2]
    assert given == "__ns:=/walker scan:=/front/scan _service:=navigation _params:={max_speed: 0.4}"
    service = listener.status("walker/skytether: service", lambda status: status.message)
    assert service.values["asked for"] == "navigation"
    process.send_signal(signal.SIGTERM)
    said, _ = process.communicate(timeout=30)
    assert process.returncode == 0, said


@pytest.mark.slow
@pytest.mark.ros2
def test_a_check_that_finds_nothing_wrong_ends_without_an_error(launched, ros2_nodes, tmp_path):
    listener = Listener(ros2_nodes.start(LISTENER, "listener"))
    (tmp_path / "orchestrator").mkdir()
    with (
        EmbeddedOrchestrator(tmp_path / "orchestrator") as orchestrator,
        Client(orchestrator.url, orchestrator.operator_token) as client,
    ):
        manifest = yaml.safe_load((ROOT / "docs" / "examples" / "wall_stop" / "service.yaml").read_text())
        client.put_service("wall-stop", Manifest.model_validate(manifest))
        (tmp_path / "walker.token").write_text(client.create_robot(RobotCreate(name="walker")).token)
        launched.write(orchestrator=orchestrator.url, service="wall-stop")
        process = launched.run("robot_run", *documented("--check"), SKYTETHER_ROBOT=str(launched.config))
        said, _ = process.communicate(timeout=60)
    assert process.returncode == 0, said
    assert "nothing is to mend" in said
    assert "[INFO]" in said.splitlines()[-1]
    assert said.splitlines()[-1].endswith("skytether robot run ended")
    ended = listener.status("skytether_launch: program", lambda status: status.message == "ended")
    assert ended.level == 3


def test_what_launch_gives_is_stronger_than_the_file():
    words = ["__ns:=/fleet/one", "cmd_vel:=/base", "scan:=/front/scan", "_topics:=[/tf]", "_use_sim_time:=true"]
    given = parse(words, {})
    changed = given.over(ROBOT | {"ros2": {"namespace": "/", "domain": 7}})
    assert changed["ros2"] == {
        "namespace": "/fleet/one",
        "domain": 7,
        "cmd_vel": "/base",
        "remap": {"scan": "/front/scan"},
        "topics": ["/tf"],
        "use_sim_time": True,
    }
    assert parse([], {"ROS_NAMESPACE": "ros1"}).over(ROBOT) == ROBOT, "ROS 2 has no such variable"


def test_rules_for_other_nodes_and_for_the_node_itself_are_left_out(monkeypatch):
    monkeypatch.syspath_prepend(PACKAGE)
    from skytether_ros.remapping import enclave, remappings

    words = "--check --ros-args -r __node:=a -r __ns:=/x --remap scan:=/s -p q:=r -r a:tf:=/t -r b:odom:=/o"
    more = "-r rostopic://map:=/m -e /walker -- -r no:=rule"
    arguments = ["robot_run", *words.split(), *more.split()]
    assert remappings(arguments, "a") == ["scan:=/s", "tf:=/t", "map:=/m"]
    assert enclave(arguments) == "/walker"
    assert not enclave(["robot_run"])


def test_the_three_launch_files_start_the_same(monkeypatch):
    from_python, from_xml, from_yaml = python_file(monkeypatch), xml_file(), yaml_file()
    assert from_python == from_xml == from_yaml
    arguments, nodes = from_python
    assert [node["exec"] for node in nodes] == ["robot_gate", "robot_run"]
    script = (PACKAGE / "setup.py").read_text()
    assert all(f"{node['exec']} = skytether_ros.nodes:" in script for node in nodes)
    assert arguments["use_sim_time"][0] == "false"
    assert {node["param"]["use_sim_time"] for node in nodes} == {"$(var use_sim_time)"}, "of both"
    used = {f"$(var {name})" for name in arguments}
    assert used == {
        value for node in nodes for value in (node["namespace"], node.get("if"), *node["param"].values())
    } - {None}


def node_of(entry):
    return entry | {"respawn": str(entry["respawn"]).lower(), "respawn_delay": str(entry["respawn_delay"])}


def xml_file():
    root = ElementTree.parse(PACKAGE / "launch" / "robot.launch.xml").getroot()
    arguments = {a.get("name"): (a.get("default"), a.get("description")) for a in root.iter("arg")}
    nodes = [node.attrib | {"param": {p.get("name"): p.get("value") for p in node}} for node in root.iter("node")]
    return arguments, [node_of(node) for node in nodes]


def yaml_file():
    entries = yaml.safe_load((PACKAGE / "launch" / "robot.launch.yaml").read_text())["launch"]
    arguments = {e["arg"]["name"]: (e["arg"]["default"], e["arg"]["description"]) for e in entries if "arg" in e}
    nodes = [e["node"] | {"param": {p["name"]: p["value"] for p in e["node"]["param"]}} for e in entries if "node" in e]
    return arguments, [node_of(node) for node in nodes]


def python_file(monkeypatch):
    """What the Python file asks of `launch` and `launch_ros`, whose names are played, in the words of the other two."""
    arguments, nodes = {}, []

    def node(*, package, executable, name, namespace, parameters, output, respawn, respawn_delay, condition=None):
        (param,) = parameters
        entry = {"pkg": package, "exec": executable, "name": name, "namespace": namespace, "output": output}
        entry |= {"respawn": respawn, "respawn_delay": respawn_delay, "param": param}
        nodes.append(node_of(entry if condition is None else entry | {"if": condition}))

    def argument(name, *, default_value, description):
        arguments[name] = (default_value, description)

    def parameter(value, *, value_type):
        assert value_type is (bool if value == "$(var use_sim_time)" else str)
        return value

    played: dict[str, dict[str, Any]] = {
        "launch": {"LaunchDescription": list},
        "launch.actions": {"DeclareLaunchArgument": argument},
        "launch.conditions": {"IfCondition": str},
        "launch.substitutions": {
            "EnvironmentVariable": lambda name, *, default_value: f"$(env {name} {default_value})",
            "LaunchConfiguration": lambda name: f"$(var {name})",
        },
        "launch_ros": {},
        "launch_ros.actions": {"Node": node},
        "launch_ros.parameter_descriptions": {"ParameterValue": parameter},
    }
    for name, content in played.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    space = {}
    exec((PACKAGE / "launch" / "robot.launch.py").read_text(), space)
    space["generate_launch_description"]()
    return arguments, nodes
