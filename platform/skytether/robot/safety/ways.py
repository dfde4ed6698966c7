"""Which way to the hardware a configuration names."""

from __future__ import annotations

from collections.abc import Callable

from .config import SafetyConfig, address
from .hardware import Address, Sensors, SocketSensors, SocketWheels, Wheels
from .protocol import SENSORS_SOCKET, WHEELS_SOCKET


def open_sensors(config: SafetyConfig, trouble: Callable[[str, str], object]) -> Sensors:
    """Where readings come from.

    Raises:
        OSError: It cannot be had.
    """
    return SocketSensors(_address(config, config.sockets.sensors, SENSORS_SOCKET), config.kinds(), trouble)


def open_wheels(config: SafetyConfig) -> Wheels:
    """Where velocities go.

    Raises:
        OSError: It cannot be had.
    """
    return SocketWheels(_address(config, config.sockets.wheels, WHEELS_SOCKET))


def _address(config: SafetyConfig, text: str | None, name: str) -> Address:
    return str(config.place() / name) if text is None else address(text)
