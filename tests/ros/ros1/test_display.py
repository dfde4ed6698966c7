"""What the gate knows, on a real ROS 1 graph: taken by rospy, by the definition that the publisher sends."""

import json
import signal

import pytest
import yaml
from gate_robot import release
from ros1_graph import wait_for

from skytether.messages import LaserScan
from skytether.robot.safety.client import ask

pytestmark = [pytest.mark.ros1, pytest.mark.slow]

HEARS = """
import json, sys, genpy.dynamic, rospy
rospy.init_node("viewer")
def hear(raw):
    header = raw._connection_header
    kinds = genpy.dynamic.generate_dynamic(header["type"], header["message_definition"])
    array = kinds[header["type"]]().deserialize(raw._buff)
    shown = [(m.id, m.type, m.action, len(m.points), m.header.frame_id, m.text) for m in array.markers]
    print(json.dumps([header["callerid"], header["md5sum"], shown]), flush=True)
rospy.Subscriber("/gate_display", rospy.AnyMsg, hear)
rospy.spin()
"""
MD5 = "d155b9ce5188fbaf89745847fd5882d7"
"""Of visualization_msgs/MarkerArray, as `rosmsg md5` of Noetic prints it."""


def test_zones_and_state_are_seen_by_a_node_of_the_robot(graph, walker, tmp_path):
    folder, path, heard = tmp_path / "gate", tmp_path / "robot.yaml", tmp_path / "heard"
    safety = {
        "footprint": {"radius": 0.3},
        "sensors": {"/scan": {"max_age_s": 1.0}},
        "display": {"rate_hz": 10},
        "guard_s": 0.5,
        "folder": str(folder),
    }
    ros1 = {"master": graph.uri, "namespace": "/"}
    path.write_text(yaml.safe_dump({"robot": "walker", "safety": safety, "ros1": ros1}))
    with (tmp_path / "gate.log").open("wb") as said, heard.open("wb") as out:
        guard = graph.skytether("robot", "gate", str(path), stdout=said, stderr=said)
        graph.python(HEARS, stdout=out)

    def newest():
        lines = [line for line in heard.read_text().splitlines(keepends=True) if line.endswith("\n")]
        return json.loads(lines[-1]) if lines else None

    def says(text):
        found = newest()
        return found if found and found[2][-1][-1].startswith(text) else None

    node, md5, shown = wait_for(lambda: says("stopped:"), "the state")
    assert (node, md5) == ("/skytether_display", MD5)
    assert graph.publishers("/gate_display") == ["/skytether_display"]
    assert {frame for *_, frame, _ in shown} == {"base_link"}
    assert [(kind, action) for _, kind, action, *_ in shown[:2]] == [(4, 0), (4, 0)]
    assert shown[0][3] == 17  # a circle has 16 corners, and is closed
    release(folder)
    wait_for(lambda: says("nobody drives"), "the reset to be seen")
    walker.scan = LaserScan()
    wait_for(lambda: (found := newest()) and "/scan" in found[2][-1][-1], "the blind laser to be seen")
    # The process that draws is killed: the robot's gate goes on, and it comes again.
    before = ask(folder, {"do": "status"}, 30)
    (display,) = [p for p in graph.processes() if "skytether.robot.safety.display.process" in p.cmdline()]
    display.send_signal(signal.SIGKILL)
    wait_for(lambda: "display ended" in (tmp_path / "gate.log").read_text(), "its end to be named")
    count = len(heard.read_text().splitlines())
    wait_for(lambda: len(heard.read_text().splitlines()) > count + 20, "the next one")
    after = ask(folder, {"do": "status"}, 30)
    assert after["pid"] == before["pid"]
    assert graph.end(guard, signal.SIGTERM) == 0
    assert "Traceback" not in (tmp_path / "gate.log").read_text()
    assert graph.publishers("/gate_display") == []
