"""Which way to the hardware a configuration names."""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import Literal

from .address import address
from .config import SafetyConfig, SocketsConfig
from .hardware import Address, Graph, Sensors, SocketSensors, SocketWheels, Wheels
from .protocol import ESTOP_SOCKET, SENSORS_SOCKET, WHEELS_SOCKET


def open_sensors(
    config: SafetyConfig, trouble: Callable[[str, str], object], estop: socket.socket | None = None
) -> Sensors:
    """Where readings and stops come from.

    Args:
        config: The section of robot.yaml.
        trouble: Told a kind and a sentence about each message that is not used.
        estop: The socket for stops, which the guard keeps while gates come and go; None: it is bound here.

    Raises:
        OSError: It cannot be had.
    """
    if config.ros1 is not None:
        from .ros1 import Ros1Sensors

        return Ros1Sensors(config.ros1, config.topics(), trouble)
    if config.ros2 is not None:
        from .ros2 import Ros2Sensors

        return Ros2Sensors(config.ros2, config.topics(), trouble)
    sockets = config.sockets or SocketsConfig()
    readings = _address(config, sockets.sensors, SENSORS_SOCKET)
    return SocketSensors(readings, estop or estop_address(config), config.topics(), trouble)


def open_wheels(config: SafetyConfig, role: Literal["guard", "gate"]) -> Wheels:
    """Where velocities go.

    Args:
        config: The section of robot.yaml.
        role: Who writes.

    Raises:
        OSError: It cannot be had.
    """
    enable = config.enable.topic if config.enable is not None and role == "guard" else None
    if config.ros1 is not None:
        from .ros1 import Ros1Wheels

        return Ros1Wheels(config.ros1, role, config.guard_s, enable or "")
    if config.ros2 is not None:
        from .ros2 import Ros2Wheels

        return Ros2Wheels(config.ros2, role, config.fresh_s(), config.brakes_s(), enable or "")
    sockets = config.sockets or SocketsConfig()
    return SocketWheels(_address(config, sockets.wheels, WHEELS_SOCKET))


def open_display(config: SafetyConfig) -> Graph:
    """Where what the gate knows is published.

    Raises:
        OSError: It cannot be had.
    """
    topic = config.display.topic if config.display is not None else ""
    if config.ros1 is not None:
        from .ros1 import Ros1Display

        return Ros1Display(config.ros1, topic)
    if config.ros2 is not None:
        from .ros2 import Ros2Display

        return Ros2Display(config.ros2, topic)
    raise OSError("there is no graph to publish it on")


def estop_address(config: SafetyConfig) -> Address:
    """Where drivers send what stops the robot."""
    return _address(config, (config.sockets or SocketsConfig()).estop, ESTOP_SOCKET)


def _address(config: SafetyConfig, text: str | None, name: str) -> Address:
    return str(config.place() / name) if text is None else address(text)
