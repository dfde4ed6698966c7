"""What a gate asks an engine itself, before it passes a call on or answers it."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Coroutine, Mapping
from http import HTTPStatus
from typing import Any, TypeVar

from .machine import Answer, ask_long, ask_soon, lean, picked

_T = TypeVar("_T")
_STATE = "Running", "Paused", "Pid", "StartedAt"
JSON, TAR = "Content-Type: application/json", "Content-Type: application/x-tar"
_GOING: set[asyncio.Task[Any]] = set()
"""A loop itself keeps no task that waits: it would be thrown away, if nobody else knows it."""


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


async def state_of(engine: str, container: str, **how: Any) -> Mapping[str, Any] | None:
    """What an engine says of the state of a container; None: nothing, or it has no such one.

    Args:
        engine: Path of its socket.
        container: Its id.
        how: As `ask_soon`.
    """
    try:
        answer = await ask_soon(engine, f"/containers/{container}/json", **how)
        return dict(picked(answer.content, "State", *_STATE)["State"])
    except (OSError, ValueError, LookupError, TypeError):
        return None


async def killed(engine: str, container: str) -> bool:
    """Have an engine end a container; says whether it does not run any more."""
    try:
        answer = await ask_long(engine, f"/containers/{container}/kill?signal=KILL", method="POST")
    except (OSError, ValueError):
        return False
    return answer.status < HTTPStatus.INTERNAL_SERVER_ERROR


def begun(work: Coroutine[Any, Any, _T]) -> asyncio.Task[_T]:
    """A task that goes on whoever waits for it, and whose failure need not be read."""
    task = asyncio.create_task(work)
    _GOING.add(task)
    task.add_done_callback(_GOING.discard)
    task.add_done_callback(lambda done: done.cancelled() or done.exception())  # whoever asked may be gone
    return task


def conflict(text: str) -> Answer:
    """What an engine would say that refuses something now, in a sentence."""
    return Answer(HTTPStatus.CONFLICT, {}, json.dumps({"message": text}).encode())
