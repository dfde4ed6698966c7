"""The robot's own wheels, odometry, button and enable signal, for `commission`. No gate runs meanwhile."""

from __future__ import annotations

import fcntl
import os
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import IO

from skytether.guard.claim import LOCK_FILE
from skytether.guard.clock import now as boottime
from skytether.guard.enable import Line, open_line
from skytether.guard.estop import LATCH_FILE, EstopFile, boot_id, lasting_file
from skytether.guard.protocol import FIRST_ACT
from skytether.guard.velocity import STANDSTILL, Velocity
from skytether.messages import Bool

from ..config.safety_config import SafetyConfig
from ..io.io_factory import open_sensors, open_wheels
from ..rules.motion import twist_of
from .commission import CommissionError

_READINGS = 20_000
"""Kept; the longest step takes half a minute, at 500 Hz at most."""
_LAST_STOPS = 10
_START_S = 10.0
"""For odometry and button to be heard."""
_UNREAD_S = 1.0
"""A driver may pause for so long: what it was told last waits in its socket, and the drives have a watchdog."""


class HardwareRig:
    """A `Rig` on the ways to the hardware that are configured.

    Args:
        config: The section of robot.yaml, with odometry.
        clock: Seconds since the machine was started.
        sleep: Waits for so many seconds.

    Raises:
        CommissionError: A gate runs, or the wheels or sensors cannot be had, or are silent.
    """

    def __init__(
        self,
        config: SafetyConfig,
        clock: Callable[[], float] = boottime,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        if config.odometry is None:
            raise CommissionError("safety.odometry is not configured: nothing could be measured")
        self._config, self._odometry = config, config.odometry
        self._clock, self._sleep = clock, sleep
        self._period = 1 / config.rate_hz
        self._lock = _lock_folder(config)
        self._refuse_a_stopped_robot()
        self._motion: deque[tuple[float, Velocity]] = deque(maxlen=_READINGS)
        self._button: tuple[bool, float] | None = None
        self._on, self._high = True, False
        self._full_since: dict[str, float] = {}
        """By what is then said: since when nobody reads, and no more can be sent."""
        self._line: Line | None = None
        self._wheels, self._sensors = None, None
        try:
            self._wheels = open_wheels(config, "guard")
            self._sensors = open_sensors(config, lambda *_: None)
            if config.enable is not None and config.enable.topic is None:
                self._line = open_line(config.enable_words())
            self._wait_for_sensors()
        except OSError as error:
            self.close()
            raise CommissionError(f"the robot cannot be had: {error}") from error
        except CommissionError:
            self.close()
            raise

    def now(self) -> float:
        """Rig: seconds since the machine was started."""
        return self._clock()

    def write_velocity(self, velocity: Velocity | None, seconds: float) -> None:
        """Rig: write at the gate's rate; see the protocol."""
        end = self.now() + seconds
        while True:
            if velocity is not None:
                self._write(velocity)
            self._toggle()
            self._sleep(self._period)
            self._read()
            if velocity is not None and velocity != STANDSTILL:
                self._check()
            if self.now() >= end:
                return

    def motion(self, since: float) -> Sequence[tuple[float, Velocity]]:
        """Rig: what was measured."""
        return [(at, velocity) for at, velocity in self._motion if at >= since]

    def pressed(self) -> bool | None:
        """Rig: the button."""
        self._read()
        button = self._config.estop
        if self._button is None or button is None:
            return None
        value, at = self._button
        silent = button.max_age_s is not None and self.now() - at > button.max_age_s
        return None if silent else value is button.pressed_is

    def power(self, on: bool) -> None:
        """Rig: the enable signal."""
        self._on = on

    def close(self) -> None:
        """Stop the wheels and let go of all."""
        if self._wheels is not None:
            for _ in range(_LAST_STOPS):
                with suppress(Exception):
                    self._wheels.write(STANDSTILL)
                self._sleep(self._period)
        for part in (self._wheels, self._sensors, self._line, self._lock):
            if part is not None:
                part.close()

    def _refuse_a_stopped_robot(self) -> None:
        """An emergency stop holds without a gate, too; that nobody has reset the machine yet is none."""
        folder = str(self._config.place())
        also = lasting_file(folder, str(self._config.record_file()))
        keeper = EstopFile(os.path.join(folder, LATCH_FILE), boot_id(), lambda _: None, also)
        stopped = keeper.before()
        if stopped and stopped != FIRST_ACT:
            self._lock.close()
            raise CommissionError(f"the robot is stopped: {stopped}; start its gate and say: skytether robot reset")

    def _wait_for_sensors(self) -> None:
        """Wait until odometry and button are heard, and the robot stands."""
        end = self.now() + _START_S
        while not self._motion or (self._config.estop is not None and self.pressed() is None):
            if self.now() > end:
                what = "odometry" if not self._motion else "emergency stop button"
                raise CommissionError(f"the {what} is not heard; see that its driver runs")
            self.write_velocity(None, 0.1)

    def _read(self) -> None:
        if self._sensors is None:
            return
        for topic, message in (*self._sensors.stops(), *self._sensors.read()):
            now = self.now()
            if topic == self._odometry.topic:
                twist = twist_of(message)
                if twist is not None:
                    self._motion.append((now, Velocity(float(twist.linear.x), float(twist.angular.z))))
            elif self._config.estop is not None and topic == self._config.estop.topic and isinstance(message, Bool):
                self._button = (bool(message.data), now)

    def _check(self) -> None:
        if not self._motion or self.now() - self._motion[-1][0] > max(self._odometry.max_age_s, 0.5):
            raise CommissionError("the odometry fell silent; the wheels are told to stand")
        if self._config.estop is not None and self.pressed() is not False:
            raise CommissionError("the emergency stop button is pressed, or not heard; the wheels are told to stand")

    def _write(self, velocity: Velocity) -> None:
        wheels = self._wheels
        if wheels is not None:
            self._send("the wheels cannot be told anything", lambda: wheels.write(velocity))

    def _toggle(self) -> None:
        if self._config.enable is None:
            return
        self._high = high = self._on and not self._high
        line, wheels = self._line, self._wheels
        if line is not None:
            self._send("the enable signal cannot be set", lambda: line.write(high))
        elif wheels is not None:
            self._send("the enable signal cannot be set", lambda: wheels.enable(high))

    def _send(self, trouble: str, send: Callable[[], None]) -> None:
        try:
            send()
            self._full_since.pop(trouble, None)
        except BlockingIOError as error:  # the same driver is there, and may read yet
            if self.now() - self._full_since.setdefault(trouble, self.now()) > _UNREAD_S:
                silent = f"{trouble}: whoever listens has read nothing for {_UNREAD_S:g} s"
                raise CommissionError(silent) from error
        except OSError as error:
            raise CommissionError(f"{trouble}: {error}") from error


def _lock_folder(config: SafetyConfig) -> IO[bytes]:
    folder = config.place()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = open(os.path.join(folder, LOCK_FILE), "ab")  # noqa: SIM115 - held until the end
    except OSError as error:
        raise CommissionError(f"cannot use the folder {folder}: {error.strerror}") from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        lock.close()
        raise CommissionError(f"a gate runs in {folder}; end it first: two must not tell the wheels") from error
    return lock
