"""How a message type is declared: one decorator, one field for arrays, equality that knows arrays."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, TypeVar, dataclass_transform

import numpy as np
from numpy.typing import NDArray

Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]
Int8s = NDArray[np.int8]
Int32s = NDArray[np.int32]
Uint8s = NDArray[np.uint8]

_BYTES = (bytes, bytearray, memoryview)


class Message:
    """Base of every message: a frozen dataclass whose fields are named and ordered as in ROS 2.

    Two messages are equal when they have the same type and the same values, arrays included; NaN equals NaN.
    """

    __slots__: ClassVar[tuple[str, ...]] = ()
    TYPE: ClassVar[str]
    """ROS 2 style name, ``geometry_msgs/msg/Twist``."""

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        return all(_equal(getattr(self, name), getattr(other, name)) for name in self.__slots__)

    def __hash__(self) -> int:
        return hash(self.TYPE)  # agrees with equality, and lets messages be defaults; not meant for large sets


_types: dict[str, type[Message]] = {}
M = TypeVar("M", bound=Message)


S = TypeVar("S", bound=np.generic)


def array(dtype: type[S], length: int = 0) -> NDArray[S]:
    """Default of a field that holds a one-dimensional NumPy array of exactly this dtype.

    Whatever NumPy understands may be given to the field (a list, another dtype, ``bytes`` for bytes): it is
    converted once.

    Args:
        dtype: Element type in memory and on the wire.
        length: Fixed number of elements, zeros by default; 0 means any number, none by default.
    """
    default = np.zeros(length, dtype)
    default.flags.writeable = False
    return default


@dataclass_transform(frozen_default=True, eq_default=False)
def message(name: str) -> Callable[[type[M]], type[M]]:
    """Make a class the message type of this name: a frozen dataclass with slots, known to ``type_of``."""

    def decorate(cls: type[M]) -> type[M]:
        arrays = {key: value for key, value in vars(cls).items() if isinstance(value, np.ndarray)}
        for key, default in arrays.items():
            setattr(cls, key, dataclasses.field(default_factory=partial(_same, default)))
        if arrays:
            cls.__post_init__ = _conversion(arrays)  # type: ignore[attr-defined]
        made = dataclasses.dataclass(frozen=True, slots=True, eq=False)(cls)
        made.TYPE = name
        _types[name] = made
        return made

    return decorate


def type_of(name: str) -> type[Message]:
    """Find the class of a ROS 2 style type name.

    Raises:
        KeyError: No message of this name is defined here; the text says which are.
    """
    try:
        return _types[name]
    except KeyError:
        raise KeyError(
            f"no message type '{name}' in skytether.messages; there are {', '.join(sorted(_types))}"
        ) from None


def all_types() -> tuple[type[Message], ...]:
    """Every message type defined here."""
    return tuple(_types.values())


def _conversion(defaults: dict[str, NDArray[Any]]) -> Callable[[Message], None]:
    """Build the ``__post_init__`` of a class with these arrays."""
    arrays = [(name, default.dtype, default.size) for name, default in defaults.items()]

    def __post_init__(self: Message) -> None:  # noqa: N807
        for name, dtype, length in arrays:
            value = getattr(self, name)
            if not (
                type(value) is np.ndarray and value.dtype is dtype and value.ndim == 1 and value.flags.c_contiguous
            ):
                if isinstance(value, _BYTES) and dtype.itemsize == 1:
                    value = np.frombuffer(value, dtype)
                value = np.ascontiguousarray(value, dtype).reshape(-1)
                object.__setattr__(self, name, value)
            if length and value.size != length:
                raise ValueError(f"{self.TYPE}: {name} needs {length} values, not {value.size}")

    return __post_init__


def _same(value: NDArray[Any]) -> NDArray[Any]:
    return value


def _equal(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        return bool(np.array_equal(a, b, equal_nan=a.dtype.kind == "f"))
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(_equal, a, b))
    return bool(a == b or (a != a and b != b))
