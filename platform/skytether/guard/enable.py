"""The enable signal: an output that changes again and again while all is well, and takes power away when it does not.

A drive, a safety relay or a retriggerable monoflop that wants this signal cuts the power when it stands still, high or
low. So nothing that ends, hangs or breaks here can keep the wheels turning. It is toggled by the guard's loop only.
"""

from __future__ import annotations

import errno
import fcntl
import os
import socket
import stat
import struct
from collections.abc import Callable, Sequence
from typing import Protocol

from .folder import check_listener
from .protocol import pack_enable
from .wheels import Address, WriterWheels, family_of

_GET_LINE = 0xC250B407
"""GPIO_V2_GET_LINE_IOCTL of linux/gpio.h, for a gpio_v2_line_request of 592 bytes."""
_SET_VALUES = 0xC010B40F
"""GPIO_V2_LINE_SET_VALUES_IOCTL, for a gpio_v2_line_values of 16 bytes."""
_OUTPUT = 1 << 3
_REQUEST = struct.Struct("=64I32sQI20x240xII20xi")
_VALUES = struct.Struct("=QQ")
_BOOL = (b"\x00\x01\x00\x00\x00", b"\x00\x01\x00\x00\x01")
"""A std_msgs/msg/Bool as CDR, little endian."""
_AGAIN_S = 1.0
"""Between attempts to open a line."""

Ioctl = Callable[[int, int, bytearray], int]


class Line(Protocol):
    """An output with two levels."""

    def write(self, high: bool) -> None:
        """Set the level. Returns at once.

        Raises:
            OSError: It is not set.
        """
        ...

    def close(self) -> None:
        """Let go of it."""
        ...


class ValueFile:
    """A file that takes 1 and 0: ``value`` of a GPIO line in sysfs, a named pipe.

    Args:
        path: Of the file.
        on_disk: It may be a regular file, for whose disk the guard's loop then waits.

    Raises:
        OSError: It cannot be opened, or is a regular file.
    """

    def __init__(self, path: str, *, on_disk: bool = False) -> None:
        if not on_disk and waits_for_a_disk(path):  # one that came after the start
            raise OSError(f"{path} is a regular file, and no value of a line in /sys")
        self._file = os.open(path, os.O_WRONLY | os.O_NONBLOCK | os.O_CLOEXEC)

    def write(self, high: bool) -> None:
        """Line: write the digit, at the beginning where the file has one."""
        data = b"1\n" if high else b"0\n"
        try:
            os.pwrite(self._file, data, 0)
        except OSError as error:
            if error.errno != errno.ESPIPE:  # a pipe has no beginning
                raise
            os.write(self._file, data)

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)


def waits_for_a_disk(path: str) -> bool:
    """Whether it is a regular file outside of /sys; one that is not there yet is none."""
    try:
        regular = stat.S_ISREG(os.stat(path).st_mode)
    except OSError:
        return False
    return regular and not os.path.realpath(path).startswith("/sys/")


class GpioLine:
    """A line of a GPIO character device (linux/gpio.h, version 2).

    Args:
        chip: Path of the device.
        offset: Number of the line on the chip.
        ioctl: Replaced by tests only.

    Raises:
        OSError: The line cannot be had.
    """

    def __init__(self, chip: str, offset: int, ioctl: Ioctl | None = None) -> None:
        self._ioctl = ioctl or fcntl.ioctl
        offsets = [offset] + [0] * 63
        request = bytearray(_REQUEST.pack(*offsets, b"skytether enable", _OUTPUT, 0, 1, 0, -1))
        device = os.open(chip, os.O_RDWR | os.O_CLOEXEC)
        try:
            self._ioctl(device, _GET_LINE, request)
        finally:
            os.close(device)
        self._line = int(_REQUEST.unpack(request)[-1])

    def write(self, high: bool) -> None:
        """Line: set its value."""
        self._ioctl(self._line, _SET_VALUES, bytearray(_VALUES.pack(int(high), 1)))

    def close(self) -> None:
        """Give the line back."""
        os.close(self._line)


class DatagramLine:
    """Each change is a datagram: a std_msgs/msg/Bool as CDR.

    Args:
        address: Of whoever switches the power; it may come later, and come again.
    """

    def __init__(self, address: Address) -> None:
        self._socket = socket.socket(family_of(address), socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._address = address

    def write(self, high: bool) -> None:
        """Line: send it, but to no other user's socket."""
        if isinstance(self._address, str):
            check_listener(self._address, "the enable signal")
        self._socket.sendto(_BOOL[high], self._address)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class WriterLine:
    """A topic: the writer publishes each change.

    Args:
        wheels: The way to the writer.
    """

    def __init__(self, wheels: WriterWheels) -> None:
        self._wheels = wheels

    def write(self, high: bool) -> None:
        """Line: have it published."""
        if self._wheels.link is None:
            raise OSError("the writer is not there")
        self._wheels.link.send(pack_enable(high=high))

    def close(self) -> None:
        """The way to the writer is the wheels'."""


class Power:
    """Whether the wheels may have power. Pure: time is an argument.

    An emergency stop brakes first, with power, and takes it away when the wheels have stood for ``after_s`` (a stop of
    category 1, IEC 60204-1). Should the told velocity not get to a standstill in the time that braking takes, or the
    wheels not be told anything, the power goes at once.

    Args:
        braking_s: The longest that braking takes [s].
        after_s: From the standstill that is told to the real one, and the brake that then holds [s].
    """

    def __init__(self, braking_s: float, after_s: float) -> None:
        self._braking_s = braking_s
        self._after_s = after_s
        self._wrong_since: float | None = None
        self._stood_since: float | None = None
        self._cut = True

    def update(self, now: float, *, well: bool, told: bool, stands: bool) -> bool:
        """Whether the signal is to change now.

        Args:
            now: [s]
            well: The gate is heard, and the robot is not stopped.
            told: The wheels were told something just now.
            stands: That was a standstill.
        """
        if well and told:
            self._wrong_since = self._stood_since = None
            self._cut = False
            return True
        if self._wrong_since is None:
            self._wrong_since = now
        self._stood_since = (self._stood_since if self._stood_since is not None else now) if stands else None
        over = not 0 <= now - self._wrong_since <= self._braking_s + self._after_s
        stood = self._stood_since is not None and not 0 <= now - self._stood_since < self._after_s
        self._cut = self._cut or not told or over or stood
        return not self._cut


class Enable:
    """Toggles a line.

    Args:
        opened: Opens it; raises OSError while it cannot be had, and is asked again.
        power: Whether it may change.
    """

    def __init__(self, opened: Callable[[], Line], power: Power) -> None:
        self._open = opened
        self._power = power
        self._line: Line | None = None
        self._tried_at: float | None = None
        self._high = False
        self.on = False
        """Whether it was toggled in the last turn."""
        self.trouble = ""
        """Why the line cannot be set; empty: it can."""

    def turn(self, now: float, *, well: bool, told: bool, stands: bool) -> None:
        """Once for every velocity that the wheels are told; see `Power.update`. Never raises, never waits."""
        on = self._power.update(now, well=well, told=told, stands=stands)
        if not on and not self.on and not self._high:
            return
        line = self._had(now)
        if line is None:
            self.on = False
            return
        self._high = on and not self._high
        try:
            line.write(self._high)
            self.on, self.trouble = on, ""
        except BlockingIOError:
            self.on, self.trouble = False, "the enable signal cannot be set: nobody takes it"
        except OSError as error:
            line.close()
            self._line, self._tried_at = None, now  # opened anew
            self.on, self.trouble = False, f"the enable signal cannot be set: {error.strerror or error}"

    def _had(self, now: float) -> Line | None:
        if self._line is None and (self._tried_at is None or not 0 <= now - self._tried_at < _AGAIN_S):
            self._tried_at = now
            try:
                self._line = self._open()
            except OSError as error:
                self.trouble = f"the enable signal's line cannot be had: {error.strerror or error}"
        return self._line


def open_line(words: Sequence[str]) -> Line:
    """A line by its words: ``file PATH`` (or ``file-on-disk``), ``gpio CHIP OFFSET``, ``unix PATH``, ``udp HOST PORT``.

    Raises:
        OSError: It cannot be had.
    """
    kind, *rest = words
    if kind == "gpio":
        return GpioLine(rest[0], int(rest[1]))
    if kind == "unix":
        return DatagramLine(rest[0])
    if kind == "udp":
        return DatagramLine((rest[0], int(rest[1])))
    if kind in ("file", "file-on-disk"):
        return ValueFile(rest[0], on_disk=kind == "file-on-disk")
    raise OSError(f"there is no line '{' '.join(words)}'")
