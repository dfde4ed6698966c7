"""``skytether robot``: all of its commands."""

from __future__ import annotations

import typer

from ...lazy import Lazy, LazyGroup


class _Robot(LazyGroup):
    table = {
        "list": Lazy("robot.registry", "list_robots", "List the registered robots."),
        "stop-afar": Lazy(
            "robot.registry",
            "stop_afar",
            "Order a robot to stop, from anywhere. Only a person beside it can reset it, with `skytether robot reset`.",
        ),
        "add": Lazy(
            "robot.registry", "add_robot", "Register a robot. Its token is printed on standard output, this once."
        ),
        "group": Lazy(
            "robot.registry",
            "group_robot",
            "Say with whose robots its services share what they see: with the same services of all robots of the"
            " group.",
        ),
        "delete": Lazy("robot.registry", "delete_robot", "Revoke a robot's token and end what it holds."),
        "status": Lazy(
            "robot.status",
            "status",
            "Show who drives this robot and why, where its service runs, and what the link is like.",
        ),
        "run": Lazy(
            "robot.run", "run", "Join the robot's ROS graph, ask for its service, and drive with what the service says."
        ),
        "gate": Lazy(
            "robot.gate",
            "gate",
            "Own the wheels: let velocities through that are safe, and stop the robot when there are none.",
        ),
        "mode": Lazy(
            "robot.gate_orders",
            "mode",
            "Say which modes of the gate hold (safety.modes): with a load, with people near.",
        ),
        "gate-status": Lazy(
            "robot.gate_orders", "gate_status", "Say who drives, what lies ahead, and what stands in the way."
        ),
        "safety-log": Lazy(
            "robot.gate", "safety_log", "Show the safety event record: what stopped the robot, who reset it, what died."
        ),
        "stop": Lazy("robot.gate_orders", "stop", "Emergency stop, until `skytether robot reset`."),
        "reset": Lazy(
            "robot.gate_orders",
            "reset",
            "End the emergency stop, after a look at the robot. Nothing moves by that alone.",
        ),
        "start": Lazy("robot.gate_orders", "start", "After a reset: let whoever wants to drive now go on."),
        "commission": Lazy(
            "robot.commission",
            "commission",
            "Measure on the real robot what its safety counts on, step by step; each is asked for first.",
        ),
    }


app = typer.Typer(
    cls=_Robot, help="Who may ask; and what runs on a robot: its agent and its gate.", no_args_is_help=True
)
