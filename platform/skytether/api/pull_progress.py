"""How far the pull of an image is, in the words of an instance's reason: what runtimes write and progress bars read."""

from __future__ import annotations

import re
from dataclasses import dataclass

_MB = 1_000_000
_WORDS = re.compile(r"(?P<step>pulling|unpacking) (?P<image>[^\s]+?)(: (?P<done>\d+) of (?P<total>\d+) MB)?")


@dataclass(frozen=True, slots=True)
class Pull:
    """One moment of a pull."""

    image: str
    unpacking: bool = False
    """All is here; it is being unpacked."""
    done: int = 0
    """Bytes, to the megabyte where it was read from words."""
    total: int = 0
    """Bytes; 0: not known yet."""

    def __str__(self) -> str:
        what = f"{'unpacking' if self.unpacking else 'pulling'} {self.image}"
        return f"{what}: {self.done / _MB:.0f} of {self.total / _MB:.0f} MB" if self.total else what


def read_pull(reason: str) -> Pull | None:
    """What a reason says of a pull; None: it is about something else."""
    found = _WORDS.fullmatch(reason)
    if found is None:
        return None
    done, total = (int(found[key] or 0) * _MB for key in ("done", "total"))
    return Pull(found["image"], found["step"] == "unpacking", done, total)
