"""What a service answers of its health over HTTP, where its runtime cannot look at its files (Kubernetes).

``/healthz`` says 200 while the service is ready and its loop alive, 503 and one sentence otherwise; ``/reports`` gives
what it reported (`skytether.api.service_report`) and what its container uses (`skytether.api.usage`). The cluster
asks every second; nothing of it is secret.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

from skytether.api.grant import DEFAULT_GRANT_PATH, GRANT_VARIABLE, Grant
from skytether.api.service_report import FILE_NAME, MOST_BYTES
from skytether.api.usage import write_usage

from .container_usage import container_usage
from .health import check

_TIMEOUT_S = 2.0
"""Of one request: one is answered at a time."""


@contextmanager
def answering(grant: Grant) -> Iterator[None]:
    """Answer on the grant's ``health_port``; 0: there is none.

    Raises:
        OSError: Another program has it.
    """
    if not grant.health_port or grant.ready_file is None:
        yield
        return
    reports = Path(grant.ready_file).with_name(FILE_NAME)
    path = os.environ.get(GRANT_VARIABLE, DEFAULT_GRANT_PATH)

    class Handler(BaseHTTPRequestHandler):
        timeout = _TIMEOUT_S

        def do_GET(self) -> None:
            if self.path == "/healthz":
                trouble = check(path, time.time())
                self._say(HTTPStatus.SERVICE_UNAVAILABLE if trouble else HTTPStatus.OK, (trouble or "alive").encode())
            elif self.path == "/reports":
                self._say(
                    HTTPStatus.OK, json.dumps({**_read(reports), "usage": write_usage(container_usage())}).encode()
                )
            else:
                self._say(HTTPStatus.NOT_FOUND, b"")

        def _say(self, status: HTTPStatus, body: bytes) -> None:
            self.send_response(status)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            """Nobody wants to read of each."""

    with HTTPServer((grant.bind_host, grant.health_port), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, name="health", daemon=True)
        thread.start()
        try:
            yield
        finally:
            server.shutdown()
            thread.join()


def _read(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            document = json.loads(file.read(MOST_BYTES))
    except (OSError, ValueError, RecursionError):
        return {}
    return document if isinstance(document, dict) else {}
