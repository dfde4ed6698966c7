"""Messages to and from the bytes of ROS 1 (``ros1``) and ROS 2 (``cdr``), through `rosbags`; no ROS needed.

Our classes are put into the type stores of `rosbags` in place of its own, so its generated code reads and fills
them directly. At its first use a type takes a few milliseconds, which `warm` takes out of a control loop's way; types
that have no class here are loaded when the first of them is needed, which takes 100 ms and more.
"""

from __future__ import annotations

import copy
import dataclasses
import struct
from collections.abc import Iterable
from functools import cache
from typing import Any, Literal, TypeVar, overload

from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from .action_definitions import ACTIONS, ONE_GENERATION
from .base import Message, all_types, type_of
from .definitions import ROS2_PARTS, definitions
from .services import BOTH, ROS2_ONLY, service_types, without_char
from .std import Header, Time
from .visualization import Marker

Encoding = Literal["cdr", "ros1"]
M = TypeVar("M", bound=Message)

BAD_BYTES = (SerdeError, struct.error, ValueError, IndexError, OverflowError, TypeError)
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
    store = _store_of(message.TYPE, encoding)
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
    store = _store_of(name, encoding)
    read = store.deserialize_cdr if encoding == "cdr" else store.deserialize_ros1
    try:
        message = read(memoryview(data), name)
    except BAD_BYTES as error:
        raise DecodeError(f"{len(data)} bytes are no {name} in {encoding}: {error}") from error
    return message  # type: ignore[return-value]


def transcode(typename: str, data: bytes | memoryview, source: Encoding, target: Encoding) -> bytes:
    """Bytes of one ROS generation as those of the other; what only one of them has is left out or zero.

    Raises:
        DecodeError: The bytes are no such message.
        KeyError: The generations do not have the same type of this name; see `transcodes`.
    """
    if source == target:
        return bytes(data)
    if not transcodes(typename):
        raise KeyError(f"{typename} is not the same type in ROS 1 and ROS 2")
    try:
        if typename in _types_with_class():
            return encode(decode(typename, data, source), target)
        # The same layout but for the sequence numbers of headers, which `rosbags` drops, and makes zero.
        store = copy.copy(typestore("cdr"))
        # What claims more elements than there are bytes is looked at for each of them: 4 bytes took 9 s.
        store.max_sequence_length = max(1, len(data))
        return bytes((store.ros1_to_cdr if source == "ros1" else store.cdr_to_ros1)(memoryview(data), typename))
    except DecodeError:
        raise
    except (*_BAD_VALUES, AssertionError) as error:
        raise DecodeError(f"{len(data)} bytes are no {typename} in {source}: {error}") from error


@cache
def transcodes(typename: str) -> bool:
    """Whether `transcode` knows a type: it has a class here, or the same fields in ROS 1 and ROS 2."""
    return _same_fields(typename, frozenset())


def _same_fields(typename: str, above: frozenset[str]) -> bool:
    """Whether a type has the same fields in both generations (but for upper case), all the way down."""
    if typename.partition("/")[0] in ONE_GENERATION:
        return False
    if typename in _types_with_class():
        return True
    both = [typestore(e).fielddefs.get(typename) for e in ("ros1", "cdr")]
    if both[0] is None or both[1] is None or typename in above:
        return False
    ros1, ros2 = ([(name.lower(), kind) for name, kind in d[1]] for d in both if d is not None)
    return ros1 == ros2 and all(_same_fields(n, above | {typename}) for n in _names_in(ros1))


def _names_in(definition: Any) -> list[str]:
    """Types that a definition refers to."""
    if isinstance(definition, tuple) and len(definition) == 2 and definition[0] == Nodetype.NAME:
        return [definition[1]]
    if isinstance(definition, tuple | list):
        return [name for part in definition for name in _names_in(part)]
    return []


@cache
def _types_with_class() -> frozenset[str]:
    return frozenset(cls.TYPE for cls in all_types())


def warm(types: Iterable[type[Message]], encoding: Encoding) -> None:
    """Do at start what would otherwise make the first message of each type late."""
    for cls in types:
        decode(cls, encode(cls(), encoding), encoding)


def type_hash(cls: type[Message], encoding: Encoding) -> str:
    """Hash of a type's definition: the MD5 of ROS 1, the RIHS01 of ROS 2 (Iron and later)."""
    return hash_of(cls.TYPE, encoding)


@cache
def hash_of(typename: str, encoding: Encoding) -> str:
    """Hash by type name, also for types that have no class here; empty if the definition is not known.

    Of services the name without ``_Request`` or ``_Response`` has a hash, in ROS 2 only.
    """
    store = _store_of(typename, encoding)
    if encoding == "cdr":
        store = _hashing_store(store)
    if typename not in store.fielddefs:
        return ""
    if encoding == "cdr":
        return store.hash_rihs01(typename)
    return store.generate_msgdef(typename)[1] if "/msg/" in typename else ""


@cache
def definition_of(typename: str, encoding: Encoding) -> str:
    """Definition in the ``.msg`` language with those it needs, as recordings hold it; empty if not known."""
    if "/msg/" not in typename:
        return ""
    try:
        return _store_of(typename, encoding).generate_msgdef(typename, ros_version=1 if encoding == "ros1" else 2)[0]
    except TypesysError:
        return ""


@cache
def typestore(encoding: Encoding) -> Typestore:
    """Load all definitions of one ROS generation and put our classes in."""
    if encoding == "cdr":
        store = get_typestore(Stores.ROS2_JAZZY)
    elif encoding == "ros1":
        store = get_typestore(Stores.ROS1_NOETIC)
        transforms = "geometry_msgs/TransformStamped[] transforms"
        store.register(get_types_from_msg(transforms, "tf2_msgs/msg/TFMessage"))
        for name, fields in ROS2_PARTS.items():
            store.register(get_types_from_msg(fields.replace(", ", "\n"), name))
    else:
        raise _unknown(encoding)
    kept = definitions(encoding)
    store.fielddefs.update({name: kept[name] for name in ACTIONS if name not in store.fielddefs})
    for name, (request, response) in (BOTH | ROS2_ONLY if encoding == "cdr" else BOTH).items():
        store.register(service_types(name, request, response, hashed=encoding == "cdr"))
    return _with_ours(store, encoding)


@cache
def _own_store(encoding: Encoding) -> Typestore:
    """Only the types that have a class here."""
    if encoding not in ("cdr", "ros1"):
        raise _unknown(encoding)
    store = Typestore()
    store.fielddefs.update(definitions(encoding))
    return _with_ours(store, encoding)


@cache
def _store_of(typename: str, encoding: Encoding) -> Typestore:
    """The small store if it has the type, else the one of all."""
    own = _own_store(encoding)
    return own if typename in own.fielddefs else typestore(encoding)


def _with_ours(store: Typestore, encoding: Encoding) -> Typestore:
    ours: dict[str, Any] = {cls.TYPE: cls for cls in all_types()}
    if encoding == "ros1":
        ours |= {Header.TYPE: _ros1_header, Marker.TYPE: _ros1_marker}
    store.types.update(ours)
    return store


def _unknown(encoding: str) -> ValueError:
    return ValueError(f"no encoding '{encoding}'; there are 'cdr' (ROS 2) and 'ros1'")


@cache
def _hashing_store(store: Typestore) -> Typestore:
    """Definitions of ROS 2 as they are hashed."""
    hashing = copy.copy(store)
    hashing.fielddefs = {name: without_char(definition) for name, definition in store.fielddefs.items()}
    return hashing


def _ros1_header(seq: int, stamp: Time, frame_id: str) -> Header:
    """ROS 1 has the sequence number first."""
    return Header(stamp, frame_id, seq)


def _ros1_marker(*fields: Any) -> Marker:
    """ROS 1 has neither textures nor files of meshes."""
    text, mesh, embedded = fields[-3:]
    return dataclasses.replace(
        Marker(*fields[:-3]), text=text, mesh_resource=mesh, mesh_use_embedded_materials=embedded
    )
