"""``ros2 launch skytether robot.launch.py``: the agent of this robot; robot.launch.xml and .yaml do the same."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    "config": (
        EnvironmentVariable("SKYTETHER_ROBOT", default_value="/etc/skytether/robot.yaml"),
        "robot.yaml of this robot",
    ),
    "namespace": ("", "Of all nodes and of the robot's topics; empty: as robot.yaml says"),
    "program": (EnvironmentVariable("SKYTETHER", default_value="skytether"), "The program skytether, by path or name"),
    "service": ("", "Service to ask for; empty: robot.yaml's"),
    "gate": ("false", "Whether the gate before the wheels is to be a process of its own, which outlives the agent"),
}


def _text(name):
    return ParameterValue(LaunchConfiguration(name), value_type=str)


def generate_launch_description():
    """The agent, and its gate if it is asked for; both are started again when they end."""
    both = {
        "package": "skytether",
        "namespace": LaunchConfiguration("namespace"),
        "output": "screen",
        "respawn": True,
        "respawn_delay": 2.0,
    }
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, (default, description) in ARGUMENTS.items()
            ),
            Node(
                executable="robot_gate",
                name="skytether_gate_launch",
                parameters=[{"config": _text("config"), "program": _text("program")}],
                condition=IfCondition(LaunchConfiguration("gate")),
                **both,
            ),
            Node(
                executable="robot_run",
                name="skytether_launch",
                parameters=[{"config": _text("config"), "program": _text("program"), "service": _text("service")}],
                **both,
            ),
        ]
    )
