from typing import get_args

from pydantic import BaseModel

from skytether.robot.safety.config.protected import protected_names
from skytether.robot.safety.config.safety_config import SafetyConfig

EVERYTHING = {
    "footprint": {"radius": 0.3},
    "sensors": {"scan": {}, "/back/scan": {}, "sonar": {"kind": "sonar"}},
    "joystick": {"topic": "joy"},
    "estop": {"topic": "/estop"},
    "sources": {"keyboard": {"topic": "teleop/cmd_vel", "priority": 20}},
    "locks": {"docked": {"topic": "/docked", "priority": 30}},
    "odometry": {"topic": "odom"},
    "contacts": {"bumper": {}},
    "modes": {"loaded": {"limits": {"linear_max": 0.1}}},
    "mode": {"topic": "/mode"},
}
NAMED = {"/walker/scan", "/back/scan", "/walker/sonar", "/walker/joy", "/estop"}
NAMED |= {"/walker/teleop/cmd_vel", "/docked", "/walker/odom", "/walker/bumper", "/mode"}


def protect(home="/walker", bridge_namespace="/", **more):
    return protected_names(SafetyConfig.model_validate(EVERYTHING | more), home, bridge_namespace)


def test_all_that_the_gate_listens_to_is_protected_by_its_own_list():
    config = SafetyConfig.model_validate(EVERYTHING)
    found = protected_names(config, "/walker")
    assert set(found) == NAMED
    assert len(found) == len(config.kinds())


def test_every_topic_of_the_section_has_a_name_that_is_looked_for():
    """What is a topic is called so, or is a key of ``sensors``: then it is protected without being named anywhere."""
    strange = {
        f"{model.__name__}.{name}"
        for model in models(SafetyConfig)
        for name, field in model.model_fields.items()
        if any(getattr(part, "max_length", None) == 255 for part in field.metadata)
        and not (name == "topic" or name.endswith("_topic") or name in ("cmd_vel", "node", "frame_id"))
    }
    assert strange == set()


def models(root):
    """A model and those within it."""
    found, waiting = [], [root]
    while waiting:
        kind = waiting.pop()
        if isinstance(kind, type) and issubclass(kind, BaseModel) and kind not in found:
            found.append(kind)
            waiting += [field.annotation for field in kind.model_fields.values()]
        waiting += get_args(kind)
    return found


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
