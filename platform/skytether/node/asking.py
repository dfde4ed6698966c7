"""What a gate asks an engine itself, before it passes a call on or answers it."""

from __future__ import annotations

from http import HTTPStatus
from typing import Any

from .machine import Answer, ask_soon, lean

JSON, TAR = "Content-Type: application/json", "Content-Type: application/x-tar"


class RefusedCall(Exception):  # noqa: N818 (an answer)
    """One sentence."""

    def __init__(self, text: str, status: HTTPStatus = HTTPStatus.FORBIDDEN) -> None:
        super().__init__(text)
        self.status = status


class Asking:
    """Asks one engine.

    Args:
        engine: Path of its socket.
    """

    def __init__(self, engine: str) -> None:
        self._engine = engine

    async def ask(self, path: str, **how: Any) -> Answer:
        """As `ask_soon`; raises `RefusedCall`."""
        try:
            return await ask_soon(self._engine, path, **how)
        except (OSError, ValueError) as error:
            raise RefusedCall(f"its engine does not answer: {error}", HTTPStatus.SERVICE_UNAVAILABLE) from error

    async def asked(self, path: str) -> tuple[int, Any]:
        """Status and document, see `lean`; raises `RefusedCall`."""
        answer = await self.ask(path)
        try:
            return answer.status, lean(answer.content)
        except ValueError as error:
            raise RefusedCall(f"its engine does not answer: {error}", HTTPStatus.SERVICE_UNAVAILABLE) from error
