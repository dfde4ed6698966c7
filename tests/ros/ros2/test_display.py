"""What the gate knows, on a ROS 2 graph: a real Zenoh router, a played viewer with the definitions of rosbags."""

import os
import signal
import subprocess
import sys

import pytest
import yaml
from rosbags.typesys import Stores, get_typestore

from skytether.api.config_file import ConfigError
from skytether.messages import MarkerArray, type_hash
from skytether.robot.config.gate_config import load_safety

SAFETY = {"footprint": {"radius": 0.3}, "sensors": {"/scan": {"max_age_s": 1.0}}, "display": {"rate_hz": 10}}


@pytest.mark.slow
def test_state_and_zones_are_seen_by_a_node_of_the_robot(stage, tmp_path):
    path = tmp_path / "robot.yaml"
    safety = SAFETY | {"guard_s": 0.5, "limits": {"max_gap_s": 0.5}, "folder": str(tmp_path / "gate")}
    graph = {"dialect": "rmw_zenoh", "router": stage.router.address, "domain": stage.domain, "namespace": "/"}
    path.write_text(yaml.safe_dump({"robot": "walker", "safety": safety, "ros2": graph}))
    kind = "visualization_msgs::msg::dds_::MarkerArray_"
    heard = stage.rmw("viewer").subscribe("/gate_display", kind, type_hash(MarkerArray, "cdr"))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with (tmp_path / "log").open("wb") as log:
        command = [sys.executable, "-m", "skytether.cli", "robot", "gate", str(path)]
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
    try:
        stage.until(lambda: heard.payloads, "nothing is shown")
        array = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr(heard.payloads[0], MarkerArray.TYPE)
        assert [marker.id for marker in array.markers] == [0, 1, 2, 3, 4, 5]
        assert {marker.header.frame_id for marker in array.markers} == {"base_link"}
        assert len(array.markers[0].points) == 17  # a circle has 16 corners, and is closed
        assert array.markers[5].text
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(30)
    assert "Traceback" not in (tmp_path / "log").read_text()


def test_without_a_graph_there_is_nobody_to_show_it_to(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text(yaml.safe_dump({"robot": "walker", "safety": SAFETY}))
    with pytest.raises(ConfigError, match="display needs ros1 or ros2"):
        load_safety(path)
