"""Messages of types that have no class here, from plain values and back: for what is said rarely, such as calls."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from .codec import BAD_BYTES, DecodeError, EncodeError, Encoding, typestore


def encode_plain(typename: str, values: Mapping[str, Any], encoding: Encoding = "cdr") -> bytes:
    """Serialise a message given as plain values: mappings for messages, lists for arrays; what is left out is zero.

    Raises:
        EncodeError: A value does not fit its field, or there is no such field.
        KeyError: The definition of the type is not known.
    """
    store = typestore(encoding)
    write = store.serialize_cdr if encoding == "cdr" else store.serialize_ros1
    try:
        return bytes(write(_build(store, typename, values), typename))
    except (*BAD_BYTES, AttributeError) as error:
        raise EncodeError(f"cannot write {typename} as {encoding}: {error}") from error


def decode_plain(typename: str, data: bytes | memoryview, encoding: Encoding = "cdr") -> Any:
    """Read a message; its fields are attributes.

    Raises:
        DecodeError: The bytes are no such message.
        KeyError: The definition of the type is not known.
    """
    store = typestore(encoding)
    store.fielddefs[typename]
    read = store.deserialize_cdr if encoding == "cdr" else store.deserialize_ros1
    try:
        return read(memoryview(data), typename)
    except (*BAD_BYTES, AssertionError) as error:
        raise DecodeError(f"{len(data)} bytes are no {typename} in {encoding}: {error}") from error


def _build(store: Any, typename: str, values: Mapping[str, Any]) -> Any:
    fields = dict(store.fielddefs[typename][1])
    for name in values:
        if name not in fields:
            raise EncodeError(f"{typename} has no field '{name}'")
    return store.types[typename](**{name: _value(store, kind, values.get(name)) for name, kind in fields.items()})


def _value(store: Any, kind: Any, given: Any) -> Any:
    node, what = kind
    if node == Nodetype.NAME:
        return _build(store, what, given or {})
    if node == Nodetype.BASE:
        return _ZEROS.get(what[0], 0) if given is None else given
    element, length = what
    if given is None:
        given = [None] * length if node == Nodetype.ARRAY else []
    values = [_value(store, element, item) for item in given]
    is_array = element[0] == Nodetype.BASE and element[1][0] not in ("string", "wstring")
    return np.array(values, _DTYPES.get(element[1][0], element[1][0])) if is_array else values


_ZEROS: dict[str, Any] = {"string": "", "wstring": "", "bool": False, "float32": 0.0, "float64": 0.0}
_DTYPES = {"byte": "uint8", "char": "uint8"}
