"""The part ``enable`` of the section ``safety``: what people write, checked."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field, field_validator, model_validator

from skytether.guard.enable import waits_for_a_disk

from ...config_base import Numbers, Topic
from .address import address, numeric

ON_DISK = "enable.file"
"""The key of ``beyond`` for a regular file."""


class EnableConfig(Numbers):
    """The enable signal: changes at every turn of the guard while all is well; one of its lines."""

    file: Path | None = None
    """Takes 1 and 0: ``value`` of a GPIO line in sysfs, or a named pipe."""
    chip: Path | None = None
    """GPIO character device, such as /dev/gpiochip0; with ``line``."""
    line: Annotated[int, Field(ge=0, le=1023)] | None = None
    """Number of the line on the chip."""
    socket: str | None = None
    """``unix:PATH`` or ``udp:HOST:PORT``: each change is a std_msgs/msg/Bool as CDR."""
    topic: Topic | None = None
    """std_msgs/msg/Bool, with ``ros1`` or ``ros2``."""
    after_s: Annotated[float, Field(ge=0)] = 0.3
    """From the standstill that is told to the end of the signal; until the wheels really stand and a brake holds."""

    @field_validator("socket")
    @classmethod
    def _an_address(cls, text: str | None) -> str | None:
        if text is not None:
            address(text)
        return text

    @model_validator(mode="after")
    def _is_one(self) -> EnableConfig:
        given = [name for name in ("file", "chip", "socket", "topic") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError("give one of file, chip (with line), socket, topic")
        if (self.chip is None) != (self.line is None):
            raise ValueError("chip and line go together")
        return self

    def words(self, *, on_disk: bool = False) -> tuple[str, ...]:
        """The line as the guard takes it.

        Args:
            on_disk: ``file`` may be a regular file.

        Raises:
            OSError: A host's name is not known, or ``file`` is a regular file.
        """
        if self.file is not None:
            path = str(self.file.absolute())
            if not on_disk and waits_for_a_disk(path):
                raise OSError(
                    f"enable.file: {path} is a regular file, and the guard would wait for its disk at every turn; name "
                    "`value` of a line in /sys or a named pipe; if this robot needs it, say why in "
                    f'safety.beyond: {{{ON_DISK}: "reason"}}'
                )
            return "file-on-disk" if on_disk else "file", path
        if self.chip is not None:
            return "gpio", str(self.chip), str(self.line)
        if self.topic is not None:
            return ("topic",)
        where = numeric(address(self.socket or ""))
        return ("unix", where) if isinstance(where, str) else ("udp", where[0], str(where[1]))
