"""From a checked configuration to the guard's process, which has none of what checking needs."""

from __future__ import annotations

import os
import sys
from typing import NoReturn

from skytether.guard.record import lost_at_reboot
from skytether.guard.settings import Settings, dump, freeze

from ..config.address import address
from ..config.safety_config import SafetyConfig, SocketsConfig
from ..io.io_factory import estop_address
from ..protocol import WHEELS_SOCKET

_PYTHON = (sys.executable, "-P")


def become_guard(config: SafetyConfig) -> NoReturn:
    """Replace this process by the guard. What is to be said is said by it, whose log is never waited for.

    Raises:
        OSError: A host's name is not known, or the kernel refuses.
    """
    _open_standard_descriptors()
    config = config.frozen()
    settings = guard_settings(config, freeze("skytether-gate", config.model_dump_json()))
    file = freeze("skytether-guard", dump(settings))
    os.execv(sys.executable, [*_PYTHON, "-m", "skytether.guard", str(file)])  # noqa: S606 - a list of arguments


def _open_standard_descriptors() -> None:
    """Where 0, 1 or 2 is closed, a socket or a configuration would get that number, and what is printed."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest that is free


def guard_settings(config: SafetyConfig, file: int) -> Settings:
    """What the guard is told.

    Args:
        config: Frozen, see `SafetyConfig.frozen`.
        file: Descriptor of the configuration of gate and writer.
    """
    on_graph = config.graph is not None
    sockets = config.sockets or SocketsConfig()
    wheels = str(config.place() / WHEELS_SOCKET) if sockets.wheels is None else address(sockets.wheels)
    say = [f"guards the wheels; its sockets are in {config.place()}"]
    say += [f"safety.{note}" for note in config.notes()]
    lost = lost_at_reboot(str(config.record_file()))
    if lost:
        say.append(lost)
    if not config.sensors:
        say.append("safety.sensors is empty: the robot does not see what it drives into")
    return Settings(
        folder=str(config.place()),
        record=str(config.record_file()),
        period_s=1 / config.rate_hz,
        patience_s=config.guard_s,
        bounds=config.bounds(),
        wheels=None if on_graph else wheels,
        estop=None if on_graph else estop_address(config),
        gate=(*_PYTHON, "-m", "skytether.robot.safety.gate.gate"),
        writer=(*_PYTHON, "-m", "skytether.robot.safety.gate.writer") if on_graph else (),
        config=file,
        display=(*_PYTHON, "-m", "skytether.robot.safety.display.process") if config.display is not None else (),
        enable=config.enable_words(),
        enable_after_s=0.0 if config.enable is None else config.enable.after_s,
        say=tuple(say),
    )
