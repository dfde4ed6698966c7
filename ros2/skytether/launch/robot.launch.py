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
    "use_sim_time": ("false", "Whether all nodes stamp with the time of /clock; false: as robot.yaml says"),
}


def _parameter(name, kind=str):
    return ParameterValue(LaunchConfiguration(name), value_type=kind)


def generate_launch_description():
    """The agent, and its gate if it is asked for; both are started again when they end."""
    both = {
        "package": "skytether",
        "namespace": LaunchConfiguration("namespace"),
        "output": "screen",
        "respawn": True,
        "respawn_delay": 2.0,
    }
    common = {
        "config": _parameter("config"),
        "program": _parameter("program"),
        "use_sim_time": _parameter("use_sim_time", bool),
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
                parameters=[common],
                condition=IfCondition(LaunchConfiguration("gate")),
                **both,
            ),
            Node(
                executable="robot_run",
                name="skytether_launch",
                parameters=[{**common, "service": _parameter("service")}],
                **both,
            ),
        ]
    )
