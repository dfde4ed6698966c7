"""The agent's log in a graph of real ROS 2: on /rosout, at the level that ROS 2's own service sets."""

import logging

import pytest
import yaml
from ros2_nodes import first, ros2_nodes, until

from skytether.robot.config.robot_config import load_config
from skytether.ros.ros1.arguments import RosArguments

__all__ = ["ros2_nodes"]
pytestmark = [pytest.mark.slow, pytest.mark.ros2]

ROBOT = {
    "robot": "one",
    "orchestrator": "http://127.0.0.1:9",
    "token_file": "one.token",
    "service": "wall-stop",
    "safety": "none",
    "ros2": {},
}
LISTENER = """
from rcl_interfaces.msg import Log, LoggerLevel
from rcl_interfaces.srv import GetLoggerLevels, SetLoggerLevels

def heard(message):
    if message.name == "one.skytether":
        say(["log", message.level, message.msg])
# As `ros2 topic echo` and rqt_console ask for it.
node.create_subscription(Log, "/rosout", heard, qos(latched=True, depth=1000))

def ask(kind, name, request):
    client = node.create_client(kind, name)
    assert client.wait_for_service(20.0)
    return client.call(request)

def work():
    for line in sys.stdin:
        levels = [LoggerLevel(name="one.skytether", level=int(line))]
        done = ask(SetLoggerLevels, "/one/skytether/set_logger_levels", SetLoggerLevels.Request(levels=levels))
        now = ask(GetLoggerLevels, "/one/skytether/get_logger_levels", GetLoggerLevels.Request(names=["one.skytether"]))
        say(["set", done.results[0].successful, now.levels[0].level])
threading.Thread(target=work, daemon=True).start()
"""


@pytest.fixture
def settings(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text(yaml.safe_dump(ROBOT))
    return load_config(path)


def test_the_log_is_on_rosout_and_ros_s_service_sets_its_level(ros2_nodes, settings, tmp_path):
    log = logging.getLogger("skytether.robot.test")
    peer = ros2_nodes.start(LISTENER)
    with settings.kind.join(settings.graph, settings.graph_config, tmp_path, RosArguments(), lambda _: None):
        log.warning("said before the graph is joined")
        log.debug("not this")
        assert first(peer, "log") == ["log", 30, "said before the graph is joined"]
        peer.tell(str(logging.DEBUG))
        assert first(peer, "set") == ["set", True, logging.DEBUG]
        until(lambda: log.isEnabledFor(logging.DEBUG), "the level")
        log.debug("but this")
        assert first(peer, "log") == ["log", 10, "but this"]
        late = ros2_nodes.start(LISTENER, "late")
        assert first(late, "log")[2] == "said before the graph is joined"
    assert not log.isEnabledFor(logging.DEBUG)
