"""The log of a running container, as the engine sends it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from ..pumped_log import SILENCE_S, PumpedLog
from .engine import Engine


class ContainerLog(PumpedLog):
    """Follows one run of a container."""

    def __init__(self, engine: Engine, container: str, lines: int) -> None:
        with engine.asked():
            api = engine.api(SILENCE_S)
            self._stream: Any = api.logs(container, stream=True, follow=True, tail=lines)
        super().__init__("docker-log")

    def _arriving(self) -> Iterator[bytes]:
        yield from self._stream

    def _let_go(self) -> None:
        self._stream.close()
