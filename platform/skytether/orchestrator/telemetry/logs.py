"""What an orchestrator writes down: its log as text or JSON, and who changed what or was refused."""

from __future__ import annotations

import json
import logging
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from typing import Any

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from skytether.api.printable import printable

from ..config.settings import Logs, syslog_address
from ..domain.rate_limit import RateLimiter
from .audit import ChainFile, Journal, Sink

AUDIT = "skytether.audit"
NOBODY = "nobody"
audit = logging.getLogger(AUDIT)
strangers = logging.getLogger("skytether.strangers")

_TEXT = "%(asctime)s %(levelname)s %(name)s: %(message)s"
_CHATTY = ("alembic", "asyncio", "httpx", "sqlalchemy", "uvicorn")
"""At level debug too; SQLAlchemy would tell what is in every row."""
_PATH = 256
"""Characters of a path that are written."""
_STRANGERS_PER_S, _STRANGERS_AT_ONCE = 10.0, 100
"""Lines of all who have shown no good token."""
_REFUSED_PER_S, _REFUSED_AT_ONCE = 0.5, 60
"""Lines on what one owner of a token asked for and did not get."""
_READS = ("GET", "HEAD", "OPTIONS")
_REFUSED = (401, 403, 429)
"""A line of reads too."""
_FAILED = 400
"""From this status on whoever asked got nothing, as of what is not there: as many lines as one who is refused."""
_CREATED = 201
_OFTEN = re.compile(r"POST /api/v1/instances/[^/]+/(renew|share) 200|PUT /api/v1/robots/[^/]+/gate 204")
"""Every robot, every few seconds, about nothing but itself: the lease, what it shares and the gate's state in the
database say it."""


class TextFormatter(logging.Formatter):
    """One line each, and an exception's lines after it: what others sent cannot look like a line of its own."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 (logging's name)
        """The line, with control characters as escapes."""
        return printable(super().formatMessage(record), lines=False)


class JsonFormatter(logging.Formatter):
    """One object a line."""

    def format(self, record: logging.LogRecord) -> str:
        """As RFC 3339 in UTC, with the fields of an audit record beside the message."""
        line: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **getattr(record, "fields", {}),
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False)


def set_up(logs: Logs) -> None:
    """Send this process's log where the settings say.

    Raises:
        OSError: The audit file cannot be written, or a sink is not there; it names which.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter() if logs.format == "json" else TextFormatter(_TEXT))
    logging.basicConfig(level=logs.level.upper(), handlers=[handler], force=True)
    for chatty in _CHATTY:
        logging.getLogger(chatty).setLevel(logging.WARNING)
    logging.getLogger("uvicorn.error").setLevel(logging.ERROR)  # strangers make its warnings, one a request
    for sink in _sinks(logs):
        sink.setFormatter(JsonFormatter())
        audit.addHandler(sink)
        audit.propagate = False
    audit.setLevel(logging.INFO)


def _sinks(logs: Logs) -> Iterator[logging.Handler]:
    if logs.audit_file is not None:
        yield ChainFile(logs.audit_file)
    if logs.audit_syslog is not None:
        yield _sink(logs.audit_syslog, lambda text: Sink(syslog_address(text)))
    if logs.audit_journald:
        yield _sink("journald", lambda _: Journal())


def _sink(name: str, make: Callable[[str], logging.Handler]) -> logging.Handler:
    try:
        return make(name)
    except OSError as error:
        error.filename = name
        raise


class Audit:
    """ASGI middleware: a line for each request that changes something or was refused. No bodies, no queries.

    Whoever has shown no good token could fill any disk with such lines, or hide among them what somebody did: theirs go
    to another log, few of them. And who asks again and again for what he does not get, for whatever reason, is told
    of a few times a minute.
    """

    def __init__(self, app: ASGIApp, clock: Callable[[], float] = time.monotonic) -> None:
        """``clock``: monotonic seconds."""
        self._app = app
        self._strangers = _Few(_STRANGERS_PER_S, _STRANGERS_AT_ONCE, clock)
        self._refused = _Few(_REFUSED_PER_S, _REFUSED_AT_ONCE, clock)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            return await self._app(scope, receive, send)
        status, made = 0, ""

        async def noting(message: Message) -> None:
            nonlocal status, made
            if message["type"] == "http.response.start":
                status = message["status"]
                made = Headers(raw=message["headers"]).get("location", "") if status == _CREATED else ""
            await send(message)

        try:
            await self._app(scope, receive, noting)
        finally:
            if scope["method"] not in _READS or status in _REFUSED:
                self._note(scope, status, made)

    def _note(self, scope: Scope, status: int, made: str) -> None:
        who = scope.get("state", {}).get("who", NOBODY)
        address = scope["client"][0] if scope.get("client") else ""
        path = scope["path"] if len(scope["path"]) <= _PATH else f"{scope['path'][:_PATH]}..."
        fields = {"who": who, "address": address, "method": scope["method"], "path": path, "status": status}
        few = self._strangers if who == NOBODY else self._refused if status >= _FAILED else None
        if few is not None:
            left_out = few.admit(who)
            if left_out is None:
                return
            if left_out:
                fields["left_out"] = left_out
        if made:
            fields["made"] = made  # which robot, token or instance: their names are in the body
        if _OFTEN.fullmatch(f"{scope['method']} {scope['path']} {status}"):
            return
        text = " ".join(str(value) for value in fields.values())
        (strangers if who == NOBODY else audit).info("%s", text, extra={"fields": fields})


class _Few:
    """So many lines of each, and how many were left out before the next."""

    def __init__(self, per_s: float, at_once: int, clock: Callable[[], float]) -> None:
        self._throttle = RateLimiter(per_s, at_once, clock)
        self._left_out: Counter[str] = Counter()

    def admit(self, who: str) -> int | None:
        """How many were left out since the last that was written; None: this one is, too."""
        if self._throttle.wait(who):
            self._left_out[who] += 1
            return None
        return self._left_out.pop(who, 0)
