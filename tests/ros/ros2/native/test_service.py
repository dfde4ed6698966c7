"""A service that is a ROS 2 graph: what its nodes are started with, and its domain; in a container see beside."""

import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import psutil
import pytest
from ros2_nodes import ros2_nodes, until

from skytether.api.grant import Grant
from skytether.service.errors import ConfigError
from skytether.service.ros2 import DOMAINS, GRAPH, nodes_command, own_domain
from skytether.service.ros_graph import ros_environment, serve, with_setup

__all__ = ["ros2_nodes"]

SLEEPER = "import time\nwhile True: time.sleep(1000)\n"


def grant(launch, **more):
    common = {"instance": "i", "service": "wall-stop", "robot": "walker", "topics": (), "graph": "ros2"}
    more = {"session_id": "0" * 16, "session_key": "MDEyMzQ1Njc4OTAxMjM0NTY3ODkwMTIzNDU2Nzg5MDE=", **more}
    return Grant(**{**common, "launch": str(launch), **more})


@pytest.fixture
def environment(tmp_path):
    """Of nodes on a machine with ROS 2's own programs."""
    (tmp_path / "bin").mkdir()
    ros2 = tmp_path / "bin" / "ros2"
    ros2.write_text("#!/bin/sh\n")
    ros2.chmod(0o755)
    return {"PATH": f"{tmp_path}/bin:/bin"}


def command(launch, environment, folder, **params):
    return nodes_command(str(launch), grant(launch, params=params), environment, "/ros/python", folder)


def test_a_program_gets_the_parameters_as_any_node_takes_them(environment, tmp_path):
    guide, other = tmp_path / "guide.py", tmp_path / "other"
    guide.touch()
    other.touch(0o755)
    assert command(guide, environment, tmp_path) == ["/ros/python", str(guide)]
    file = str(tmp_path / "parameters.yaml")
    more = ["--ros-args", "--params-file", file]
    params = {"speed": 2.0, "word": "1", "planner": {"on": True}, "names": ["a", "ü"]}
    assert command(other, environment, tmp_path, **params) == [str(other), *more]
    assert json.loads(Path(file).read_text()) == {"/**": {"ros__parameters": params}}
    assert command("tools/relay", environment, tmp_path, a=1) == ["ros2", "run", "tools", "relay", *more]


@pytest.mark.parametrize("package", ["", "nav"])
def test_a_launch_file_is_included_with_arguments_and_its_nodes_get_the_parameters(
    package, environment, tmp_path, monkeypatch
):
    """Played as ``launch`` and ``launch_ros`` document themselves; they are not to be had where this was made."""
    path = tmp_path / "nav.launch.py"
    path.touch()
    launch = f"{package}/nav.launch.py" if package else str(path)
    *ros2, launcher = command(launch, environment, tmp_path, rate=2.5, on=True)
    assert ros2 == ["ros2", "launch"]
    played: dict[str, dict[str, Any]] = {
        "launch": {"LaunchDescription": list},
        "launch.actions": {"IncludeLaunchDescription": lambda source, launch_arguments: (source, launch_arguments)},
        "launch.launch_description_sources": {"AnyLaunchDescriptionSource": lambda path: path},
        "launch_ros.actions": {"SetParametersFromFile": lambda path: path},
        "ros2launch.api": {
            "get_share_file_path_from_package": lambda package_name, file_name: f"/share/{package_name}/{file_name}"
        },
    }
    for name, members in played.items():
        for part in (name.partition(".")[0], name):
            monkeypatch.setitem(sys.modules, part, types.ModuleType(part))
        vars(sys.modules[name]).update(members)
    sys.modules["launch"].LaunchDescription = list
    parameters, (included, arguments) = runpy.run_path(launcher)["generate_launch_description"]()
    assert parameters == str(tmp_path / "parameters.yaml")
    assert included == ("/share/nav/nav.launch.py" if package else launch)
    assert dict(arguments) == {"rate": "2.5", "on": "true", "robot": "walker", "service": "wall_stop"}
    ((bare, _),) = runpy.run_path(command(launch, environment, tmp_path)[-1])["generate_launch_description"]()
    assert bare == included


@pytest.mark.parametrize(
    ("launch", "params", "says"),
    [
        ("/nowhere/guide.py", {}, "cannot read /nowhere/guide.py, which launch names"),
        ("guide.py", {}, "must be an absolute path, package/file.launch.py or package/program, not 'guide.py'"),
        ("HERE/guide", {}, "may not be run: chmod"),
        ("HERE/guide", {"a": None}, "ROS 2 takes no such value: parameter a"),
        ("HERE/guide", {"a": {"b": [1, "x"]}}, r"ROS 2 takes no such value: parameter a\.b"),
        ("HERE/guide", {"a": 2**64}, "ROS 2 takes no such value"),
    ],
)
def test_what_cannot_be_started_is_told_in_a_sentence(launch, params, says, environment, tmp_path):
    (tmp_path / "guide").touch(0o644)
    with pytest.raises(ConfigError, match=says):
        command(launch.replace("HERE", str(tmp_path)), environment, tmp_path, **params)


@pytest.mark.parametrize("launch", ["nav/nav.launch.py", "nav/relay"])
def test_without_ros_2s_own_programs_only_a_path_can_be_started(launch, tmp_path):
    with pytest.raises(ConfigError, match=r"needs the program 'ros2', which is not in this image: build it on"):
        command(launch, {"PATH": "/bin"}, tmp_path)


def test_every_graph_has_a_domain_that_nobody_else_has():
    with own_domain() as first, own_domain() as second:
        assert first["ROS_AUTOMATIC_DISCOVERY_RANGE"] == second["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
        assert first["ROS_DOMAIN_ID"] != second["ROS_DOMAIN_ID"]
        taken = int(second["ROS_DOMAIN_ID"])
        assert taken in DOMAINS
    with socket.socket(type=socket.SOCK_DGRAM) as other:  # as somebody's first node in that domain has it
        other.bind(("127.0.0.1", 7400 + 250 * taken + 10))
        with own_domain() as third, own_domain() as fourth:
            assert str(taken) not in (third["ROS_DOMAIN_ID"], fourth["ROS_DOMAIN_ID"])


def test_nodes_get_the_set_up_of_ros_and_nothing_of_ours(tmp_path):
    setup = tmp_path / "setup.bash"
    setup.write_text('echo sourced; export PATH="/ros/bin:$PATH" ROS_DISTRO=jazzy PYTHONPATH=/ros/python\n')
    environ = {
        "PATH": f"{Path(sys.executable).parent}:/usr/bin:/bin",
        "PYTHONPATH": "/ours",
        "SKYTETHER_GRANT": "/secret",
        "SKYTETHER_ROS_SETUP": str(setup),
        "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp",
    }
    found = with_setup(environ, ros_environment(environ, tmp_path, {"ROS_DOMAIN_ID": "7"}, ["RMW_IMPLEMENTATION"]))
    assert found["PATH"] == "/ros/bin:/usr/bin:/bin"
    assert found["PYTHONPATH"] == "/ros/python"
    assert (found["ROS_DOMAIN_ID"], found["RMW_IMPLEMENTATION"]) == ("7", "rmw_cyclonedds_cpp")
    assert "SKYTETHER_GRANT" not in found


def run_here(tmp_path, capsys, given, python="/bin/false"):
    (tmp_path / "grant.json").write_text(given.model_dump_json())
    environ = {"SKYTETHER_GRANT": str(tmp_path / "grant.json"), "PATH": "/bin", "SKYTETHER_ROS2_PYTHON": python}
    return serve(GRAPH, environ), capsys.readouterr().err


def test_an_image_without_ros_2_says_so(tmp_path, capsys):
    status, said = run_here(tmp_path, capsys, grant("/nodes/guide.py"))
    assert status == 1
    assert said.count("\n") == 1
    assert "graph: ros2 needs ROS 2 where the service runs" in said
    assert "build its image on skytether/ros2-base" in said


def test_a_manifest_of_another_generation_is_refused(tmp_path, capsys):
    status, said = run_here(tmp_path, capsys, grant("/nav.launch", graph="ros1"))
    assert (status, said.count("\n")) == (2, 1)
    assert "the manifest of wall-stop says graph: ros1, but its image or entry point starts a graph of ros2" in said
    assert "build the image on skytether/ros1-base" in said


@pytest.mark.ros2
@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_domain_and_programs_end_with_the_service_also_if_it_is_killed(number, ros2_nodes, tmp_path):
    (tmp_path / "tmp").mkdir()
    guide, ready = tmp_path / "guide.py", tmp_path / "ready.json"
    guide.write_text(SLEEPER)
    (tmp_path / "grant.json").write_text(grant(guide, ready_file=str(ready)).model_dump_json())
    more = {"SKYTETHER_GRANT": str(tmp_path / "grant.json"), "TMPDIR": str(tmp_path / "tmp")}
    process = subprocess.Popen(
        [sys.executable, "-m", "skytether.service.ros2"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **more},
        start_new_session=True,
    )
    try:
        until(ready.exists, "the service")
        (folder,) = (tmp_path / "tmp").iterdir()
        ours = psutil.Process(process.pid).children(recursive=True)
        assert any("side/__main__.py" in " ".join(child.cmdline()) for child in ours)
        os.killpg(process.pid, number)
        assert process.wait(30) == (0 if number == signal.SIGTERM else -number)
        until(lambda: not any(child.is_running() for child in ours), "all programs to end")
        until(lambda: not folder.exists(), "the folder to be removed")
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
