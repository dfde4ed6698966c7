"""Whether the echo of a machine that joined answers, looked for from here: as robots that are where we are would."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable

from skytether.bridge.echo import EchoClient

ASK_S, _TRIES = 0.5, 3
"""For how long an echo is waited for, and how often it is asked."""
ECHOES, PATIENCE_S = 8, 3.0
"""Looks for echoes at once, of all nodes, and how long a node waits for one."""


class EchoLooks:
    """Looks for the echoes of all nodes, for one loop."""

    def __init__(self, where: Callable[[str], tuple[str, int] | None]) -> None:
        """``where``: what a node says of its echo; it may wait for the database."""
        self._where = where
        self._under_way = 0

    async def answers(self, name: str) -> bool | None:
        """Whether the echo of a node answers; None: it has none, or that could not be found out soon.

        In a thread that nobody waits for: a node says the name under which it is, and whoever resolves that may hang.
        """
        where = await asyncio.to_thread(self._where, name)
        if where is None or self._under_way >= ECHOES:
            return None
        loop = asyncio.get_running_loop()
        answered: asyncio.Future[bool] = loop.create_future()

        def resolve(answers: bool) -> None:
            self._under_way -= 1
            if not answered.done():
                answered.set_result(answers)

        def probe() -> None:
            answers = echo_answers(*where)
            with contextlib.suppress(RuntimeError):  # all of it has ended meanwhile
                loop.call_soon_threadsafe(resolve, answers)

        self._under_way += 1
        threading.Thread(target=probe, name="node-echo", daemon=True).start()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(PATIENCE_S):
                return await answered
        return None


def echo_answers(host: str, port: int) -> bool:
    """Whether a UDP echo answers."""
    try:
        with EchoClient(host, port) as client:
            return any(client.ask(ASK_S) is not None for _ in range(_TRIES))
    except (OSError, UnicodeError):  # UnicodeError: not a name that could be looked up
        return False
