"""Many requests at once: bounded, refused in time, nothing lost, nothing twice."""

from __future__ import annotations

import asyncio
from typing import Any

from skytether.orchestrator.crowd import Crowd


async def _no_body() -> dict[str, Any]:
    return {"type": "http.request", "body": b"", "more_body": False}


def test_beyond_the_bound_they_are_told_to_come_again() -> None:
    async def crowd() -> None:
        go = asyncio.Event()
        told: list[dict[str, Any]] = []

        async def app(scope: Any, receive: Any, send: Any) -> None:
            await go.wait()
            if scope["path"] == "/broken":
                raise ValueError
            await send({"type": "http.response.start", "status": 200, "headers": []})
            await asyncio.sleep(0)

        async def send(message: Any) -> None:
            told.append(message)

        def ask(path: str) -> asyncio.Task[None]:
            scope = {"type": "http", "path": path, "method": "GET", "headers": [], "query_string": b""}
            return asyncio.create_task(bounded(scope, _no_body, send))  # type: ignore[arg-type]

        bounded = Crowd(app, 2)
        waiting = [ask("/a"), ask("/broken")]
        await asyncio.sleep(0)
        await ask("/c")
        assert [(m["status"], (b"retry-after", b"1") in m["headers"]) for m in told if "status" in m] == [(503, True)]
        waiting.append(ask("/healthz"))
        go.set()
        results = await asyncio.gather(*waiting, return_exceptions=True)
        assert isinstance(results[1], ValueError)
        told.clear()
        await asyncio.gather(ask("/a"), ask("/b"))
        assert [m["status"] for m in told] == [200, 200]

    asyncio.run(crowd())
