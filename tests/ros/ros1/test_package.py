"""The package folder for ROS users: roslaunch, the script that it starts, the unit of systemd."""

import os
import shutil
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import pytest
from ros1_graph import wait_for

from skytether.guard import privileges

ROOT = Path(__file__).parents[3]
PACKAGE = ROOT / "ros1" / "skytether"
UNITS = [
    PACKAGE / "systemd" / "skytether-robot.service",
    ROOT / "docs" / "examples" / "robot" / "skytether-gate.service",
]
NODE = ROOT / "docs" / "examples" / "node" / "skytether-node.service"
ORCHESTRATOR = ROOT / "docs" / "examples" / "orchestrator" / "skytether-orchestrator.service"


@pytest.fixture
def robot_yaml(tmp_path):
    """A robot whose orchestrator is away."""
    token = tmp_path / "walker.token"
    token.touch(0o600)
    token.write_text("secret")
    path = tmp_path / "robot.yaml"
    path.write_text(
        "robot: walker\norchestrator: http://127.0.0.1:9\ntoken_file: walker.token\nservice: virtual-trail\n"
        "safety: none\nstatus_port: null\nros1: {namespace: /}\n"
    )
    return path


@pytest.mark.ros1
@pytest.mark.slow
def test_roslaunch_skytether_robot_launch_is_all_that_a_ros_user_types(graph, program, robot_yaml):
    more = {
        "ROS_PACKAGE_PATH": f"{PACKAGE.parent}:/usr/share",
        "SKYTETHER": str(program),
        "SKYTETHER_ROBOT": str(robot_yaml),
    }
    launched = graph.start("roslaunch", "skytether", "robot.launch", env={**graph.environment, **more})
    wait_for(lambda: graph.publishers("/cmd_vel") == ["/skytether"], "the agent's node")
    graph.end(launched)
    wait_for(lambda: graph.publishers("/cmd_vel") == [], "its end")


def test_the_script_says_what_is_missing_and_passes_on_what_is_not_ros_s(tmp_path):
    script = str(PACKAGE / "scripts" / "robot_run")
    missing = subprocess.run(
        [script, "x.yaml"], capture_output=True, text=True, env={"PATH": "/usr/bin:/bin", "SKYTETHER": "not-there"}
    )
    assert missing.returncode == 2
    assert "pip install skytether" in missing.stderr
    echo = subprocess.run(
        [script, "a b.yaml", "__name:=skytether", "--check", "__log:=/x"],
        capture_output=True,
        text=True,
        env={"PATH": "/usr/bin:/bin", "SKYTETHER": "echo"},
    )
    assert echo.stdout == "robot run a b.yaml __name:=skytether --check __log:=/x\n"


def test_the_package_s_files_are_what_catkin_and_roslaunch_read():
    package = ElementTree.parse(PACKAGE / "package.xml").getroot()
    assert package.findtext("name") == "skytether"
    (node,) = ElementTree.parse(PACKAGE / "launch" / "robot.launch").getroot().iter("node")
    assert (node.get("pkg"), node.get("type")) == ("skytether", "robot_run")
    assert os.access(PACKAGE / "scripts" / "robot_run", os.X_OK)


@pytest.mark.usefixtures("systemd")
@pytest.mark.parametrize("source", [*UNITS, ORCHESTRATOR, NODE], ids=lambda path: path.name)
def test_the_units_are_ones_that_systemd_takes(tmp_path, source):
    unit = tmp_path / source.name
    text = source.read_text()
    unit.write_text(text.replace("/opt/skytether/bin/skytether", shutil.which("true")))
    checked = subprocess.run(["systemd-analyze", "verify", str(unit)], capture_output=True, text=True)
    assert checked.returncode == 0
    assert unit.name not in checked.stderr


@pytest.mark.usefixtures("systemd")
@pytest.mark.parametrize(
    ("source", "tenths"),
    [(UNITS[0], 26), (UNITS[1], 26), (ORCHESTRATOR, 19), (NODE, 21)],
    ids=["robot", "gate", "orchestrator", "node"],
)
def test_the_units_are_scored(source, tenths):
    """Of 100, the worst; a unit that says nothing has 96."""
    words = ["systemd-analyze", "security", "--offline=true", f"--threshold={tenths}", "--no-pager", str(source)]
    scored = subprocess.run(words, capture_output=True, text=True)
    assert scored.returncode == 0, scored.stdout.splitlines()[-1]


def test_agent_and_gate_meet_in_one_folder():
    folders = {line for unit in UNITS for line in unit.read_text().splitlines() if "XDG_RUNTIME_DIR" in line}
    assert folders == {"Environment=XDG_RUNTIME_DIR=/run"}
    # Whichever starts last gives the folder its owner and mode, so both have to say the same of it.
    said = [[line for line in unit.read_text().splitlines() if line.startswith("RuntimeDirectory")] for unit in UNITS]
    assert said[0] == said[1] == ["RuntimeDirectory=skytether", "RuntimeDirectoryPreserve=yes"]
    assert all("StateDirectory=skytether" in unit.read_text().splitlines() for unit in UNITS)  # of the event record
    assert {"User=skytether"} == {line for unit in UNITS for line in unit.read_text().splitlines() if "User=" in line}


def test_when_the_first_process_of_a_unit_dies_the_others_have_time_to_stop_the_wheels():
    """With KillMode=mixed systemd kills all that is left of a unit as soon as its first process is gone."""
    for unit in UNITS:
        lines = unit.read_text().splitlines()
        assert "KillMode=control-group" in lines
        assert "TimeoutStopSec=20" in lines
    # The watchdog's signal goes to all of the unit, so the gate must have stopped the wheels before.
    assert "WatchdogSec=5" in UNITS[1].read_text().splitlines()


def test_the_gates_unit_permits_what_guard_and_gate_ask_for():
    lines = UNITS[1].read_text().splitlines()
    assert f"LimitRTPRIO={privileges.GUARD}" in lines
    assert "LimitMEMLOCK=infinity" in lines
