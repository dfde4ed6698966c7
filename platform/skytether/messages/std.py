"""``builtin_interfaces`` and ``std_msgs``."""

from __future__ import annotations

import math

from .base import Message, message

_NANO = 1_000_000_000


@message("builtin_interfaces/msg/Time")
class Time(Message):
    """A point in time: seconds and nanoseconds since the epoch of whatever clock stamped it."""

    sec: int = 0
    nanosec: int = 0

    @classmethod
    def from_seconds(cls, seconds: float) -> Time:
        """Round to whole nanoseconds (a float of today's Unix time holds about 200 ns)."""
        sec, nanosec = _split(seconds)
        return cls(sec, nanosec)

    def seconds(self) -> float:
        """As a float, s."""
        return self.sec + self.nanosec / _NANO


@message("builtin_interfaces/msg/Duration")
class Duration(Message):
    """A span of time; ``nanosec`` counts up from ``sec`` also when that is negative (-0.5 s is -1 s + 5e8 ns)."""

    sec: int = 0
    nanosec: int = 0

    @classmethod
    def from_seconds(cls, seconds: float) -> Duration:
        """Round to whole nanoseconds."""
        sec, nanosec = _split(seconds)
        return cls(sec, nanosec)

    def seconds(self) -> float:
        """As a float, s."""
        return self.sec + self.nanosec / _NANO


@message("std_msgs/msg/Header")
class Header(Message):
    """When and in which coordinate frame something was measured."""

    stamp: Time = Time()
    frame_id: str = ""
    seq: int = 0
    """ROS 1 only, where it goes first on the wire; not part of a ROS 2 header."""


@message("std_msgs/msg/String")
class String(Message):
    """Text, UTF-8."""

    data: str = ""


@message("std_msgs/msg/Bool")
class Bool(Message):
    """True or false."""

    data: bool = False


@message("std_msgs/msg/ColorRGBA")
class ColorRGBA(Message):
    """A colour: red, green, blue and opacity, each 0 to 1."""

    r: float = 0.0
    g: float = 0.0
    b: float = 0.0
    a: float = 0.0


@message("std_msgs/msg/Float32")
class Float32(Message):
    """One number of single precision."""

    data: float = 0.0


@message("std_msgs/msg/Float64")
class Float64(Message):
    """One number of double precision."""

    data: float = 0.0


def _split(seconds: float) -> tuple[int, int]:
    whole = math.floor(seconds)
    nanosec = round((seconds - whole) * _NANO)
    return whole + nanosec // _NANO, nanosec % _NANO
