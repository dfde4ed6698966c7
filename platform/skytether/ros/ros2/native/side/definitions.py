"""Definitions of types as recordings hold them: the text of each .msg, as rosbag2 finds it, one below the other."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

from . import types

_BETWEEN = "=" * 80
_BASIC = {"boolean": "bool", "octet": "byte", "float": "float32", "double": "float64"}
"""What IDL calls otherwise than .msg does."""
_SEQUENCE = re.compile(r"sequence<(.+?)(?:, (\d+))?>")
_ARRAY = re.compile(r"(.+)\[(\d+)\]")
_NESTED = re.compile(r"\w+/\w+")
_CONSTANT = {bool: "bool", int: "int64", float: "float64", str: "string"}


def definition(name: str) -> str:
    """Of ``acme_msgs/msg/Odd`` with all that it is made of.

    Raises:
        types.NotInstalledError: ROS 2's Python does not have one of them.
    """
    found: dict[str, str] = {}
    waiting = {_short(name): (name, types.load(name))}
    while waiting:
        short, (full, cls) = next(iter(waiting.items()))
        del waiting[short]
        found[short] = _installed(full) or _built(cls)
        for other in _nested(cls):
            if other not in found:
                waiting[other] = _loaded(other)
    first, *rest = found
    return found[first] + "".join(f"{_BETWEEN}\nMSG: {other}\n{found[other]}" for other in rest)


def _installed(name: str) -> str:
    """The .msg beside the Python of its package; empty: there is none (an IDL, a part of an action), or no field."""
    package, kind, short = name.split("/")
    for prefix in Path(str(sys.modules[package].__file__)).parents:
        path = prefix / "share" / package / kind / f"{short}.msg"
        if path.is_file():
            text = path.read_text(encoding="utf-8", errors="replace")
            return text.rstrip("\n") + "\n" if text.strip() else ""
    return ""


def _built(cls: Any) -> str:
    """The same from the class, of which comments and defaults are not known."""
    lines = [f"{_type(kind)} {name}" for name, kind in cls.get_fields_and_field_types().items()]
    lines = lines or ["uint8 structure_needs_at_least_one_member"]  # as it is in CDR
    found = (value for name, value in vars(type(cls)).items() if name.endswith("__constants"))
    for name, value in next(found, {}).items():
        if isinstance(value, bytes):
            lines.append(f"byte {name}={value[0]}")
        elif "\n" not in str(value):
            lines.append(f"{_CONSTANT[type(value)]} {name}={value}")
    return "\n".join(lines) + "\n"


def _type(kind: str) -> str:
    """A field's type: ``sequence<double, 3>`` is ``float64[<=3]``."""
    sequence = _SEQUENCE.fullmatch(kind)
    if sequence is not None:
        most = f"<={sequence[2]}" if sequence[2] else ""
        return f"{_type(sequence[1])}[{most}]"
    array = _ARRAY.fullmatch(kind)
    if array is not None:
        return f"{_type(array[1])}[{array[2]}]"
    return _BASIC.get(kind) or kind.replace("string<", "string<=").rstrip(">")


def _nested(cls: Any) -> list[str]:
    """Types that fields of a class have, such as ``std_msgs/Header``."""
    return [name for kind in cls.get_fields_and_field_types().values() for name in _NESTED.findall(kind)]


def _loaded(short: str) -> tuple[str, Any]:
    """Full name and class of a type that a field has: a message, or a part of an action or service."""
    package, _, name = short.partition("/")
    for kind in ("msg", "action", "srv"):
        full = f"{package}/{kind}/{name}"
        try:
            return full, types.load(full)
        except types.NotInstalledError:
            continue
    raise types.NotInstalledError(f"type {short} is not known to ROS 2 here")


def _short(name: str) -> str:
    package, _, short = name.split("/")
    return f"{package}/{short}"
