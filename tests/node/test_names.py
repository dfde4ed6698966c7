"""Names that take for ever to be resolved hold up nobody else."""

from __future__ import annotations

import asyncio
import socket
import threading
from typing import Any

import pytest

from skytether.node.names import Names


def test_a_name_that_takes_for_ever_holds_up_no_other_and_is_asked_for_once(monkeypatch: pytest.MonkeyPatch) -> None:
    goes_on, asked = threading.Event(), []

    def resolve(host: str, *_: Any, **__: Any) -> list[Any]:
        asked.append(host)
        if host.startswith("slow"):
            goes_on.wait(20)
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, 0)) for address in ("192.0.2.1", "192.0.2.1")]

    monkeypatch.setattr("skytether.node.names.socket.getaddrinfo", resolve)

    async def run() -> None:
        names = Names(3)
        for _ in range(3):
            for slow in ("slow-1", "slow-2"):
                with pytest.raises(TimeoutError):
                    await asyncio.wait_for(names.find(slow), 0.01)
        assert await asyncio.wait_for(names.find("quick"), 10) == ["192.0.2.1"]
        goes_on.set()
        assert await names.find("slow-1") == ["192.0.2.1"]
        names.close()

    asyncio.run(run())
    assert asked.index("quick") == 2
    assert asked.count("slow-2") == 1
