"""What distinguishes the wheels of one robot of ROS 2 from those of another."""

from skytether.robot.graphs.ros2.kind import Ros2
from skytether.robot.graphs.ros2.sections import Ros2Way


def wheels_at(**way):
    return Ros2().wheels_at(Ros2Way.model_validate(way))


def test_wheels_of_another_domain_are_others_also_where_the_environment_names_it(monkeypatch):
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    assert wheels_at(namespace="/walker", cmd_vel="wheels") == "/walker/wheels of the ROS 2 domain 0"
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    assert wheels_at(namespace="/walker", cmd_vel="wheels") == "/walker/wheels of the ROS 2 domain 7"
    assert wheels_at(cmd_vel="/wheels", domain=9) == "/wheels of the ROS 2 domain 9"


def test_where_a_zenoh_router_is_the_way_it_counts_too():
    way = {"cmd_vel": "/wheels", "dialect": "rmw_zenoh", "domain": 9}
    assert wheels_at(**way) == "/wheels of the ROS 2 domain 9 by the usual router"
    assert wheels_at(**way, router="tcp/10.0.0.5:7447").endswith("by tcp/10.0.0.5:7447")
