"""Messages to and from the bytes of ROS 1 (``ros1``) and ROS 2 (``cdr``), through `rosbags`; no ROS needed.

Our classes are put into the type stores of `rosbags` in place of its own, so its generated code reads and fills
them directly. The stores are loaded at first use: 60 ms each, and a few milliseconds more for each type, which
`warm` takes out of a control loop's way.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from functools import cache
from typing import Any, Literal, TypeVar, overload

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from .base import Message, all_types, type_of
from .std import Header, Time

Encoding = Literal["cdr", "ros1"]
M = TypeVar("M", bound=Message)

_BAD_BYTES = (SerdeError, struct.error, ValueError, IndexError, OverflowError, TypeError)
_BAD_VALUES = (SerdeError, struct.error, ValueError, IndexError, OverflowError, TypeError, AttributeError)


class DecodeError(ValueError):
    """Bytes that are not a message of the type they were taken for."""


class EncodeError(ValueError):
    """A message that holds a value which its type has no room for."""


def encode(message: Message, encoding: Encoding = "cdr") -> bytes:
    """Turn a message into bytes.

    Raises:
        EncodeError: A field holds the wrong kind of value, or a number that does not fit.
        ValueError: There is no such encoding.
    """
    store = _store(encoding)
    write = store.serialize_cdr if encoding == "cdr" else store.serialize_ros1
    try:
        return bytes(write(message, message.TYPE))
    except _BAD_VALUES as error:
        raise EncodeError(f"cannot write {message.TYPE} as {encoding}: {error}") from error


@overload
def decode(what: type[M], data: bytes | memoryview, encoding: Encoding = ...) -> M: ...
@overload
def decode(what: str, data: bytes | memoryview, encoding: Encoding = ...) -> Message: ...
def decode(what: type[Message] | str, data: bytes | memoryview, encoding: Encoding = "cdr") -> Message:
    """Turn bytes into a message of the class or type name ``what``. Arrays are read-only views of ``data``.

    Raises:
        DecodeError: The bytes are no such message.
        KeyError: There is no message type of that name here.
        ValueError: There is no such encoding.
    """
    name = what if isinstance(what, str) else what.TYPE
    if isinstance(what, str):
        type_of(what)
    store = _store(encoding)
    read = store.deserialize_cdr if encoding == "cdr" else store.deserialize_ros1
    try:
        message = read(memoryview(data), name)
    except _BAD_BYTES as error:
        raise DecodeError(f"{len(data)} bytes are no {name} in {encoding}: {error}") from error
    return message  # type: ignore[return-value]


def warm(types: Iterable[type[Message]], encoding: Encoding) -> None:
    """Do at start what would otherwise make the first message of each type late."""
    for cls in types:
        decode(cls, encode(cls(), encoding), encoding)


def type_hash(cls: type[Message], encoding: Encoding) -> str:
    """Hash of a type's definition: the MD5 of ROS 1, the RIHS01 of ROS 2 (Iron and later)."""
    return hash_of(cls.TYPE, encoding)


@cache
def hash_of(typename: str, encoding: Encoding) -> str:
    """Hash by type name, also for types that have no class here; empty if the definition is not known."""
    store = _store(encoding)
    if typename not in store.fielddefs:
        return ""
    return store.hash_rihs01(typename) if encoding == "cdr" else store.generate_msgdef(typename)[1]


@cache
def definition_of(typename: str, encoding: Encoding) -> str:
    """Definition in the ``.msg`` language with those it needs, as recordings hold it; empty if not known."""
    try:
        return _store(encoding).generate_msgdef(typename, ros_version=1 if encoding == "ros1" else 2)[0]
    except TypesysError:
        return ""


@cache
def _store(encoding: Encoding) -> Typestore:
    """Load the definitions of one ROS generation and put our classes in."""
    if encoding == "cdr":
        store = get_typestore(Stores.ROS2_JAZZY)
    elif encoding == "ros1":
        store = get_typestore(Stores.ROS1_NOETIC)
        transforms = "geometry_msgs/TransformStamped[] transforms"
        store.register(get_types_from_msg(transforms, "tf2_msgs/msg/TFMessage"))
    else:
        raise ValueError(f"no encoding '{encoding}'; there are 'cdr' (ROS 2) and 'ros1'")
    ours: dict[str, Any] = {cls.TYPE: cls for cls in all_types()}
    if encoding == "ros1":
        ours[Header.TYPE] = _ros1_header
    store.types.update(ours)
    return store


def _ros1_header(seq: int, stamp: Time, frame_id: str) -> Header:
    """ROS 1 has the sequence number first."""
    return Header(stamp, frame_id, seq)
