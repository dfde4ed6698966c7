"""What containers use: the engine sends it about once a second, a stream for each that runs."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from .engine import Engine

_SILENCE_S = 30.0
"""A stream over which nothing came for so long is given up; the next look at the container opens another."""


_MOST = 1 << 60
"""Bytes, or nanoseconds, of one run: 36 years of a processor, and more than any network carries."""


@dataclass(frozen=True, slots=True)
class Usage:
    """Of one run, so far or now."""

    cpu_s: float
    memory_bytes: int
    received_bytes: int
    sent_bytes: int


def usage_of(message: Mapping[str, Any]) -> Usage | None:
    """Out of one message of the engine; None: the container was not running then."""
    memory = message.get("memory_stats") or {}
    if "usage" not in memory:
        return None
    details = memory.get("stats") or {}
    # What the kernel could drop at any time is not counted; control groups of both versions name it.
    idle = details.get("inactive_file", details.get("total_inactive_file", 0))
    networks = (message.get("networks") or {}).values()
    return Usage(
        cpu_s=_counted(message["cpu_stats"]["cpu_usage"]["total_usage"]) / 1e9,
        memory_bytes=_counted(max(0, memory["usage"] - idle)),
        received_bytes=_counted(sum(network["rx_bytes"] for network in networks)),
        sent_bytes=_counted(sum(network["tx_bytes"] for network in networks)),
    )


def _counted(told: Any) -> int:
    """A count that a database holds; sums of it over all runs of a service, too.

    Raises:
        ValueError: It is none.
    """
    if isinstance(told, int) and 0 <= told < _MOST:
        return told
    raise ValueError(f"no container counts {str(told)[:30]}")


class Meter:
    """Follows containers' use, each in a thread of its own, from ``follow`` until ``forget``."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._lock = threading.Lock()
        self._wanted: set[str] = set()
        self._streams: dict[str, Any] = {}
        self._usage: dict[str, Usage] = {}

    def usage(self, container: str) -> Usage | None:
        """The newest; None: nothing came yet."""
        return self._usage.get(container)

    def follow(self, container: str, most: int) -> None:
        """Begin, unless it is followed already, or so many others are."""
        with self._lock:
            if container not in self._streams and len(self._streams) >= most:
                return
            self._wanted.add(container)
            if container in self._streams:
                return
            self._streams[container] = None
        threading.Thread(target=self._run, args=(container,), name="docker-stats", daemon=True).start()

    def forget(self, container: str) -> None:
        """It runs no more."""
        with self._lock:
            self._wanted.discard(container)
            self._usage.pop(container, None)
            _end(self._streams.get(container))

    def close(self) -> None:
        """Forget all."""
        for container in list(self._wanted):
            self.forget(container)

    def _run(self, container: str) -> None:
        try:
            with suppress(Exception):  # however it ends, the next look at the container begins anew
                stream = self._engine.api(_SILENCE_S).stats(container, decode=True, stream=True)
                with self._lock:
                    self._streams[container] = stream
                for message in stream:
                    usage = usage_of(message)
                    del message  # not kept until the next one comes
                    with self._lock:
                        if container not in self._wanted:
                            return
                        if usage is not None:
                            self._usage[container] = usage
        finally:
            with self._lock:
                _end(self._streams.pop(container, None))


def _end(stream: Any) -> None:
    if stream is not None:
        with suppress(Exception):  # of a connection that is half gone, anything
            stream.close()
