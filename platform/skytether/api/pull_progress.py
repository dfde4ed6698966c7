"""How far the pull of an image is: runtimes tell it, progress bars read it."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field
from typing_extensions import override

from .manifest import Strict

_MB = 1_000_000
_Bytes = Annotated[int, Field(ge=0)]


class PullProgress(Strict):
    """One moment of a pull."""

    image: str
    unpacking: bool = False
    """All of it is here and is being unpacked."""
    done_bytes: _Bytes = 0
    """So much is here, or unpacked."""
    total_bytes: _Bytes = 0
    """0: not known yet."""

    @override
    def __str__(self) -> str:
        what = f"{'unpacking' if self.unpacking else 'pulling'} {self.image}"
        if not self.total_bytes:
            return what
        return f"{what}: {self.done_bytes / _MB:.0f} of {self.total_bytes / _MB:.0f} MB"
