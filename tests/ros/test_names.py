import pytest

from skytether.api.manifest import TopicSpec
from skytether.ros.names import GraphNameError, Names, bridge_type, check_name, namespace_of, ros1_type


def spec(name, direction="in", **more):
    return TopicSpec(name=name, type=more.pop("type", "std_msgs/msg/String"), direction=direction, **more)


@pytest.mark.parametrize("name", ["scan", "/scan", "/_hidden", "a/_b", "/3d/points", "~private", "/", "A_1"])
def test_ros1_takes_these_names(name):
    assert check_name(name) == name


@pytest.mark.parametrize("name", ["_scan", "3d", "", "/a//b", "/a/", "a b", "ä", "-x", "x" * 256])
def test_ros1_refuses_these_names(name):
    with pytest.raises(GraphNameError, match="not a valid name of a graph"):
        check_name(name)


def test_ros2_takes_an_underscore_first_and_no_digit_at_a_token_s_start():
    assert check_name("_hidden", 2) == "_hidden"
    assert check_name("/a/_b", 2) == "/a/_b"
    with pytest.raises(GraphNameError, match="digit"):
        check_name("/3d/points", 2)


def test_names_of_robots_and_services_become_namespaces_that_are_legal_everywhere():
    assert [namespace_of(n) for n in ("walker", "virtual-trail", "3po")] == ["/walker", "/virtual_trail", "/_3po"]
    assert all(check_name(namespace_of("3po"), ros) for ros in (1, 2))


def test_types_of_ros_1_and_of_manifests():
    assert ros1_type("sensor_msgs/msg/LaserScan") == "sensor_msgs/LaserScan"
    assert ros1_type("sensor_msgs/LaserScan") == "sensor_msgs/LaserScan"
    assert bridge_type("sensor_msgs/LaserScan") == "sensor_msgs/msg/LaserScan"
    assert bridge_type("std_srvs/SetBool", "srv") == "std_srvs/srv/SetBool"
    assert bridge_type("sensor_msgs/msg/LaserScan") == "sensor_msgs/msg/LaserScan"


def test_what_a_robot_sends_is_under_its_namespace_and_what_a_service_sends_under_the_service_s():
    names = Names([spec("scan"), spec("path", "out"), spec("/tf")], "/walker", "/virtual_trail")
    assert [names.of(n) for n in ("scan", "path", "/tf")] == ["/walker/scan", "/virtual_trail/path", "/tf"]


def test_calls_and_actions_live_where_they_are_answered():
    rows = [
        spec("plan", kind="call", type="nav_msgs/srv/GetPlan"),
        spec("say", "out", kind="call", type="std_srvs/srv/Trigger"),
        spec("move", kind="action", type="move_base_msgs/action/MoveBase"),
    ]
    names = Names(rows, "/walker", "/navigation", {"move": "/move_base"})
    assert names.of("plan") == "/navigation/plan"
    assert names.of("say") == "/walker/say"
    assert names.of("plan/request") == "/navigation/plan/request"
    assert [names.of(f"move/{part}") for part in ("goal", "status")] == ["/move_base/goal", "/move_base/status"]


def test_remapping_by_absolute_and_relative_names():
    names = Names([spec("scan"), spec("odom")], "/walker", "/s", {"scan": "/front/scan", "odom": "wheels/odom"})
    assert names.of("scan") == "/front/scan"
    assert names.of("odom") == "/walker/wheels/odom"
    assert names.own("force") == "/walker/force"


def test_a_remapping_of_nothing_is_found_and_an_illegal_name_refused():
    names = Names([spec("scan")], "/", "/s", {"scna": "/scan", "cmd_vel": "/base/cmd_vel"})
    assert names.unused(["cmd_vel"]) == ["scna"]
    assert Names([spec("*", type="*")], "/", "/s", {"scan": "/x"}).unused() == []
    with pytest.raises(GraphNameError, match="3 d"):
        Names([spec("scan")], "/", "/s", {"scan": "3 d"})


def test_what_only_a_row_for_anything_takes_keeps_its_name():
    assert Names([spec("*", type="*")], "/walker", "/recorder").of("/camera/image") == "/camera/image"
