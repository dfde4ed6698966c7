"""Following the log of a container, whoever writes it and however slowly it is read: no engine needed."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import closing, nullcontext
from typing import Any

from skytether.orchestrator.runtimes.docker.logs import ContainerLog

PATIENCE = 10.0


class Flood:
    """An engine with a container that writes without end; as the SDK's client, a stream of pieces."""

    def __init__(self) -> None:
        self.taken = 0
        """Bytes."""
        self.closed = threading.Event()

    def asked(self) -> Any:
        return nullcontext()

    def api(self, _timeout_s: float) -> Any:
        return self

    def logs(self, container: str, **_: Any) -> Any:
        return self

    def __iter__(self) -> Iterator[bytes]:
        while not self.closed.is_set():
            self.taken += 1 << 16
            yield bytes(1 << 16)

    def close(self) -> None:
        self.closed.set()


def test_a_log_that_nobody_reads_costs_next_to_no_memory() -> None:
    """A robot may have dozens of them: 60 MB each were two gigabytes of the orchestrator's memory."""
    engine: Any = Flood()
    with closing(ContainerLog(engine, "c", 10)) as log:
        before, deadline = -1, time.monotonic() + PATIENCE
        while engine.taken != before and time.monotonic() < deadline:
            before = engine.taken
            time.sleep(0.05)
        assert 0 < engine.taken <= 2 << 20
        for _ in range(100):
            assert log.read() == "\0" * (1 << 16), "and whoever reads gets all of it"
