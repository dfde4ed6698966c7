"""The nodes: each has its parameters and its diagnostics, and one program of `skytether` as its child.

The child has the robot's topics, and nodes of its own. It ends when its node is told to, or dies; the node ends when
its child does, with the child's exit code, so that `respawn` starts both again.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from .parameters import Declared, of_program, of_robot, words
from .remapping import enclave, remappings

WRONG = 2
"""Exit code where the node is started in a way that cannot work, as `skytether` has it."""
_TOLD = (signal.SIGINT, signal.SIGTERM)
_ENDED = {0, *(128 + number for number in _TOLD), *(-number for number in _TOLD)}
"""How a program ends that was told to."""
_LOOK_S = 0.1
"""Between two looks at the child; the executor of rclpy lets no signal through in between."""
_DIAGNOSTICS_S = 1.0
"""Between two messages, as REP 107 wants it."""
_LAST_WORD_S = 1.0
"""For the last diagnostics to reach who listens."""


class Role(NamedTuple):
    """What a node starts.

    Attributes:
        name: Of the node, where ROS gives none.
        command: Words of `skytether`.
        parameters: Beside `of_program`.
    """

    name: str
    command: tuple[str, ...]
    parameters: list[Declared]


class StartError(Exception):
    """The text says what to change."""


def robot_run() -> None:
    """``ros2 run skytether robot_run``: the robot's agent."""
    sys.exit(run(Role("skytether_launch", ("robot", "run"), of_robot()), sys.argv))


def robot_gate() -> None:
    """``ros2 run skytether robot_gate``: the gate before the wheels, in a process of its own."""
    sys.exit(run(Role("skytether_gate_launch", ("robot", "gate"), []), sys.argv))


def run(role: Role, arguments: Sequence[str]) -> int:
    """Be the node until its child ends. Returns the exit code.

    Args:
        role: Which.
        arguments: The command line: ROS's own, and options for the child.
    """
    try:
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node(role.name)
    except Exception as error:
        return _wrong(f"{type(error).__name__}: {_first_line(error)}")
    try:
        command, environment = _command(node, role, arguments)
        return _Child(node, command, environment).run()
    except (StartError, ParameterException) as error:
        return _wrong(_first_line(error))
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def _wrong(text: str) -> int:
    print(f"error: {text}", file=sys.stderr)  # noqa: T201 - before there is a node that could log it
    return WRONG


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def _command(node: Node, role: Role, arguments: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """What to start, and its environment.

    Raises:
        StartError: A program or file is missing.
        ParameterException: ROS gave a value that a parameter cannot have.
    """
    values: dict[str, Any] = {declared.name: declared.on(node) for declared in (*of_program(), *role.parameters)}
    program = shutil.which(os.path.expanduser(values["program"]))
    if program is None:
        raise StartError(
            f"there is no program '{values['program']}'; install it with 'pip install skytether', or name it: "
            "program:=/path/to/skytether"
        )
    config = Path(values["config"]).expanduser()
    if not config.is_file():
        raise StartError(f"there is no file '{config}'; name this robot's robot.yaml: config:=/path/to/robot.yaml")
    given = [*remappings(arguments, node.get_name()), *words(values)]
    if node.get_namespace() != "/":  # which launch gives, too, where nobody has said anything
        given.insert(0, f"__ns:={node.get_namespace()}")
    if node.get_parameter_or("use_sim_time").value is True:
        given.append("_use_sim_time:=true")
    options = remove_ros_args(list(arguments))[1:]
    environment = {"SKYTETHER_ROS2_PYTHON": sys.executable, **os.environ}
    if enclave(arguments):
        environment["ROS_SECURITY_ENCLAVE_OVERRIDE"] = enclave(arguments)
    return [program, *role.command, str(config), *options, "--", *given], environment


class _Child:
    """The program, and what the graph is told of it."""

    def __init__(self, node: Node, command: Sequence[str], environment: dict[str, str]) -> None:
        self._node = node
        self._command = list(command)
        self._environment = environment
        self._told: set[int] = set()
        self._diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._process: subprocess.Popen[bytes] | None = None

    def run(self) -> int:
        """Start it and stay until it has ended. Returns the exit code."""
        for number in _TOLD:
            signal.signal(number, self._tell)
        bound = [sys.executable, str(Path(__file__).with_name("bound.py")), str(os.getpid())]
        # In a session of its own a terminal's Ctrl-C reaches it once, through us.
        process = subprocess.Popen(
            [*bound, *self._command], stdin=subprocess.DEVNULL, env=self._environment, start_new_session=True
        )
        self._process = process
        for told in self._told:  # came while it was being started
            process.send_signal(told)
        try:
            self._spin(process)
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()
        return self._end(process.returncode)

    def _spin(self, process: subprocess.Popen[bytes]) -> None:
        executor = SingleThreadedExecutor()
        executor.add_node(self._node)
        self._publish(DiagnosticStatus.OK, "runs")
        # Not by the node's clock: a simulation that stands still is no reason to be silent.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        timer = self._node.create_timer(
            _DIAGNOSTICS_S, lambda: self._publish(DiagnosticStatus.OK, "runs"), clock=steady
        )
        while process.poll() is None:
            executor.spin_once(timeout_sec=_LOOK_S)
        timer.cancel()

    def _tell(self, number: int, _: object) -> None:
        """Pass on a signal, each once: launch sends what the terminal has sent already."""
        if number not in self._told:
            self._told.add(number)
            if self._process is not None:
                self._process.send_signal(number)

    def _end(self, code: int) -> int:
        name = " ".join(self._command[:3])
        if self._told and code in _ENDED:
            self._publish(DiagnosticStatus.STALE, "was told to end")
            return 0
        if code == 0:  # as with `--check`
            self._node.get_logger().info(f"{name} ended")
            self._publish(DiagnosticStatus.STALE, "ended")
        else:
            how = f"by {signal.Signals(-code).name}" if code < 0 else f"with code {code}"
            self._node.get_logger().error(f"{name} ended {how}")
            self._publish(DiagnosticStatus.ERROR, f"ended {how}")
        self._diagnostics.wait_for_all_acked(Duration(seconds=_LAST_WORD_S))
        return code if code >= 0 else 128 - code

    def _publish(self, level: bytes, message: str) -> None:
        told = DiagnosticArray()
        told.header.stamp = self._node.get_clock().now().to_msg()
        process = self._process.pid if self._process is not None else 0
        values = {"command": " ".join(self._command), "process": process}
        told.status = [
            DiagnosticStatus(
                level=level,
                name=f"{self._node.get_fully_qualified_name().lstrip('/')}: program",
                message=message,
                values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
            )
        ]
        self._diagnostics.publish(told)
