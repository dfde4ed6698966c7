from skytether.robot.safety.config import SafetyConfig
from skytether.robot.safety.protected import protected_names

EVERYTHING = {
    "footprint": {"radius": 0.3},
    "sensors": {"scan": {}, "/back/scan": {}, "sonar": {"kind": "sonar"}},
    "joystick": {"topic": "joy"},
    "estop": {"topic": "/estop"},
}


def protect(home="/walker", bridge_namespace="/", **more):
    return protected_names(SafetyConfig.model_validate(EVERYTHING | more), home, bridge_namespace)


def test_all_that_the_gate_listens_to_is_protected_by_its_own_list():
    config = SafetyConfig.model_validate(EVERYTHING)
    found = protected_names(config, "/walker")
    assert set(found) == {"/walker/scan", "/back/scan", "/walker/sonar", "/walker/joy", "/estop"}
    assert len(found) == len(config.kinds())


def test_a_namespace_and_wheels_of_the_gate_s_own_are_protected_too():
    found = protect(ros1={"namespace": "/base", "cmd_vel": "cmd_vel_safe"})
    assert {"/base/scan", "/walker/scan", "/base/cmd_vel_safe", "/walker/cmd_vel_safe"} <= set(found)
    assert "wheels" in found["/base/cmd_vel_safe"]


def test_a_bridge_to_dds_may_put_a_namespace_before_the_gate_s_names():
    dds = {"dialect": "ros2dds", "bridge_namespace": "/bot", "cmd_vel": "/cmd_vel"}
    # The gate's key in Zenoh is bot/cmd_vel; an agent whose bridge has no namespace writes it as a name.
    assert "/bot/cmd_vel" in protect("/", ros2=dds)
    assert "/bot/cmd_vel" not in protect("/", "/bot", ros2=dds)
    assert "/cmd_vel" in protect("/", "/bot", ros2=dds)
