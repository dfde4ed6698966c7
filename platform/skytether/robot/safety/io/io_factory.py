"""Which way to the hardware a configuration names."""

from __future__ import annotations

import socket
from collections.abc import Callable

from skytether.guard.board import Place

from ...graphs.gate_io import Display, Sensors, Wheels
from ...graphs.kind import Role
from ..config.address import address
from ..config.safety_config import SafetyConfig, SocketsConfig
from ..protocol import ESTOP_SOCKET, SENSORS_SOCKET, WHEELS_SOCKET
from .hardware import Address, SocketSensors, SocketWheels


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
    if config.graph is not None:
        kind, way = config.graph
        return kind.open_sensors(way, config.topics(), trouble)
    sockets = config.sockets or SocketsConfig()
    readings = _address(config, sockets.sensors, SENSORS_SOCKET)
    return SocketSensors(readings, estop or estop_address(config), config.topics(), trouble)


def open_wheels(config: SafetyConfig, role: Role, place: Place | None = None) -> Wheels:
    """Where velocities go.

    Args:
        config: The section of robot.yaml.
        role: Who writes.
        place: See `skytether.robot.graphs.kind.GraphKind.open_wheels`.

    Raises:
        OSError: It cannot be had.
    """
    if config.graph is not None:
        kind, way = config.graph
        enable = config.enable.topic if config.enable is not None and role == "guard" else None
        return kind.open_wheels(way, role, config.wheels_timing(), enable or "", place)
    sockets = config.sockets or SocketsConfig()
    return SocketWheels(_address(config, sockets.wheels, WHEELS_SOCKET))


def open_display(config: SafetyConfig) -> Display:
    """Where what the gate knows is published.

    Raises:
        OSError: It cannot be had.
    """
    if config.graph is not None:
        kind, way = config.graph
        return kind.open_display(way, config.display.topic if config.display is not None else "")
    raise OSError("there is no graph to publish it on")


def estop_address(config: SafetyConfig) -> Address:
    """Where drivers send what stops the robot."""
    return _address(config, (config.sockets or SocketsConfig()).estop, ESTOP_SOCKET)


def _address(config: SafetyConfig, text: str | None, name: str) -> Address:
    return str(config.place() / name) if text is None else address(text)
