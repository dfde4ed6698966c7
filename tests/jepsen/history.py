"""What happened, in the order in which it was noted: one dictionary for each, as a line of JSON.

Every entry has ``t``, seconds of the monotonic clock since the run began, and ``kind``:

| kind | fields |
| --- | --- |
| ``op`` | ``n``, ``step`` (invoke, ok, fail, unknown), ``op`` (create, renew, delete, migrate), ``who``, ``replica``; ``id``, ``key``, ``lease_s``; answered: ``state``, ``reason``, ``successor``; failed: ``status``, ``reason`` |
| ``event`` | ``stream``, ``id`` of the instance, ``event`` (its number), ``state``, ``reason`` |
| ``stream`` | ``stream``, ``id``, ``step``: begin, again (over another connection), end (the instance has ended), lost |
| ``look`` | ``place``, ``runs``: names of the runs of each instance that live at the same time |
| ``leader`` | ``leaders``: the number of the orchestrator that leads by the database, and can; empty: nobody does |
| ``fault`` | ``fault``, ``step`` (begin, heal, over), ``hits``: the instances of which a run was hit |
| ``traceback`` | ``line``: of an orchestrator's log, and the traceback that follows it |
| ``final`` | ``when`` (settled, drained), ``instances`` and ``events`` as in the database, ``runs``; ``standbys``: how many there are to be, by service |
"""  # noqa: E501 (a table)

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

Entry = dict[str, Any]


class History:
    """Kept, and written to a file as it grows, so that a run that is killed leaves it too. Safe from any thread."""

    def __init__(self, path: Path | None = None) -> None:
        self.entries: list[Entry] = []
        self._began = time.monotonic()
        self._lock = threading.Lock()
        self._numbers = 0
        self._file = path.open("w") if path else None

    def now(self) -> float:
        return time.monotonic() - self._began

    def number(self) -> int:
        """Another one, for an operation or a stream."""
        with self._lock:
            self._numbers += 1
            return self._numbers

    def add(self, kind: str, **fields: Any) -> Entry:
        with self._lock:
            entry: Entry = {"t": round(self.now(), 4), "kind": kind, **fields}
            self.entries.append(entry)
            if self._file:
                self._file.write(json.dumps(entry) + "\n")
                self._file.flush()
        return entry

    def close(self) -> None:
        if self._file:
            self._file.close()


def read(lines: Iterable[str]) -> list[Entry]:
    """A history that was written."""
    return [json.loads(line) for line in lines]
