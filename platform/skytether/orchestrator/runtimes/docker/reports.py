"""What services in containers report: the engine is asked for their files, now and then and in a thread."""

from __future__ import annotations

import base64
import io
import json
import logging
import tarfile
import time
from collections.abc import Callable, Iterable, Mapping
from http import HTTPStatus
from typing import Any

from skytether.api.service_report import MOST_BYTES, ServiceReport, pull_reports, pull_step_s

from ..base import RuntimeFailure
from ..now_and_then import NowAndThen
from .engine import Engine
from .objects import REPORTS

log = logging.getLogger(__name__)

_EVERY_S = 3.0
"""Seconds between two looks at all of them; each file costs the engine some 3 ms, and one that changed 50 to 100."""
_STAT = "X-Docker-Container-Path-Stat"
"""Header with what the engine knows of a file without reading it."""
_NO_FILE = 1 << 19
"""The lowest of Go's bits in a file's mode that say that it is none: a folder, a link, a device."""

_MOST_ARCHIVE = MOST_BYTES + (8 << 10)
"""Of the archive of one such file: the file, and some heads of 512 bytes. A service may have put a huge file in the
place of the one that the engine told of."""

Known = tuple[str, tuple[ServiceReport, ...], float | None]
"""What the engine said of a file, and what was read of it then: reports, and how long steps take [s]."""


class ReportReader:
    """Knows the newest reports of an engine's containers. Safe from any thread."""

    def __init__(
        self, engine: Engine, running: Callable[[], Iterable[str]], clock: Callable[[], float] = time.monotonic
    ) -> None:
        """``running`` tells the containers to look at; it may raise what the engine's failure is."""
        self._engine = engine
        self._running = running
        self._now_and_then = NowAndThen("docker-reports", _EVERY_S, clock, self._refresh_quietly)
        self._known: Mapping[str, Known] = {}

    def of(self, container: str) -> tuple[ServiceReport, ...]:
        """What it reported, as read last."""
        known = self._known.get(container)
        return known[1] if known is not None else ()

    def step_s(self, container: str) -> float | None:
        """How long it says that its steps take, as read last."""
        known = self._known.get(container)
        return known[2] if known is not None else None

    def begin(self) -> None:
        """Look at them, unless that is under way or was done a moment ago. Does not wait."""
        self._now_and_then.begin()

    def _refresh_quietly(self) -> None:
        try:
            self.refresh()
        except RuntimeFailure as error:
            log.debug("reports of services are not read: %s", error)

    def refresh(self) -> None:
        """Look at all of them now.

        Raises:
            RuntimeFailure: The engine does not answer.
        """
        found: dict[str, Known] = {}
        for container in self._running():
            known = self._read(container)
            if known is not None:
                found[container] = known
        self._known = found

    def _read(self, container: str) -> Known | None:
        """None: it has reported nothing, or is gone."""
        api: Any = self._engine.api()  # a `Client`; told as the SDK's, which has no `fetch`
        with self._engine.asked():
            url = f"{api.base_url}/v{api.api_version}/containers/{container}/archive"
            asked: dict[str, Any] = {"params": {"path": REPORTS}, "timeout": api.timeout}
            head = api.head(url, **asked)
            stat = head.headers.get(_STAT, "")
            if head.status_code != HTTPStatus.OK or not _is_readable(stat):
                return None
        known = self._known.get(container)
        if known is not None and known[0] == stat:
            return known
        try:
            with self._engine.asked():
                answer = api.fetch(url, _MOST_ARCHIVE, **asked)
        except RuntimeFailure as error:
            # The engine has answered just before. A file that changes while it is packed is its service's doing, and
            # must not keep those of others from being read.
            log.debug("reports of container %.12s are not read: %s", container, error)
            return known
        if answer.status_code != HTTPStatus.OK:
            return None
        document = unpacked(answer.content)
        return stat, pull_reports(document), pull_step_s(document)


def _is_readable(stat: str) -> bool:
    """Whether what the engine says of a file is that it is one, and not larger than reports are."""
    try:
        told = json.loads(base64.b64decode(stat))
        return bool(told["mode"] < _NO_FILE and told["size"] <= MOST_BYTES)
    except (ValueError, KeyError, TypeError):
        return False


def unpacked(archive: bytes) -> Any:
    """The document in the one file of an archive; None: there is no such."""
    try:
        with tarfile.open(fileobj=io.BytesIO(archive), mode="r:") as tar:  # not packed: it may unpack to anything
            entry = tar.next()
            file = tar.extractfile(entry) if entry is not None and entry.isreg() and entry.size <= MOST_BYTES else None
            return json.loads(file.read()) if file is not None else None
    except (tarfile.TarError, ValueError, RecursionError, OSError):
        return None
