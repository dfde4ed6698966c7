"""What an orchestrator writes down: its log as text or JSON, and who changed what or was refused."""

from __future__ import annotations

import json
import logging
import sys
from datetime import UTC, datetime
from logging.handlers import RotatingFileHandler
from typing import Any

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from .settings import Logs

AUDIT = "skytether.audit"
audit = logging.getLogger(AUDIT)

_TEXT = "%(asctime)s %(levelname)s %(name)s: %(message)s"
_CHATTY = ("alembic", "asyncio", "httpx", "sqlalchemy", "uvicorn")
"""At level debug too; SQLAlchemy would tell what is in every row."""
_AUDIT_BYTES, _AUDIT_FILES = 10_000_000, 5
_READS = ("GET", "HEAD", "OPTIONS")
_REFUSED = (401, 403, 429)
_CREATED = 201


class TextFormatter(logging.Formatter):
    """One line each, and an exception's lines after it: what others sent cannot look like a line of its own."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 (logging's name)
        """The line, with control characters as escapes."""
        return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in super().formatMessage(record))


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
        OSError: The audit file cannot be written.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter() if logs.format == "json" else TextFormatter(_TEXT))
    logging.basicConfig(level=logs.level.upper(), handlers=[handler], force=True)
    for chatty in _CHATTY:
        logging.getLogger(chatty).setLevel(logging.WARNING)
    if logs.audit_file is not None:
        file = RotatingFileHandler(logs.audit_file, maxBytes=_AUDIT_BYTES, backupCount=_AUDIT_FILES)
        file.setFormatter(JsonFormatter())
        audit.addHandler(file)
        audit.propagate = False
    audit.setLevel(logging.INFO)


class Audit:
    """ASGI middleware: a line for each request that changes something or was refused. No bodies, no queries."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

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
        who = scope.get("state", {}).get("who", "nobody")
        address = scope["client"][0] if scope.get("client") else ""
        fields = {"who": who, "address": address, "method": scope["method"], "path": scope["path"], "status": status}
        if made:
            fields["made"] = made  # which robot, token or instance: their names are in the body
        if scope["path"].endswith("/renew") and status == 200:
            return  # every robot, every two seconds: the lease in the database says it
        text = " ".join(str(value) for value in fields.values())
        audit.info("%s", text, extra={"fields": fields})
