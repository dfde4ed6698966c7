"""Many requests at once: bounded, refused in time, nothing lost, nothing twice."""

from __future__ import annotations

import asyncio
import json
import resource
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from orchestrator_program import PATIENCE, Program, until, with_toy

from skytether.api.rest import SiteCreate, State

MANY = 1000


@pytest.fixture
def many_files() -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    if before[1] < 2 * MANY:
        pytest.skip(f"only {before[1]} files may be open")
    resource.setrlimit(resource.RLIMIT_NOFILE, (2 * MANY, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, before)


class Caller:
    """Asks on a connection of its own, as robots do, and comes again when it is told to."""

    def __init__(self, url: str, token: str) -> None:
        self._host, _, port = url.removeprefix("http://").partition(":")
        self._port = int(port)
        self._token = token
        self.statuses: set[int] = set()
        """All that were answered."""

    async def ask(self, method: str, path: str, document: Any = None, key: str = "") -> Any:
        for _ in range(int(4 * PATIENCE)):
            status, headers, body = await self._once(method, path, document, key)
            self.statuses.add(status)
            if status != 503:
                return json.loads(body) if body else None
            await asyncio.sleep(float(headers["retry-after"]))
        raise AssertionError(f"{method} {path} was never answered")

    async def _once(self, method: str, path: str, document: Any, key: str) -> tuple[int, dict[str, str], bytes]:
        body = b"" if document is None else json.dumps(document).encode()
        lines = [f"{method} /api/v1{path} HTTP/1.1", "Host: localhost", f"Authorization: Bearer {self._token}"]
        lines += ["Connection: close", f"Content-Length: {len(body)}", "Content-Type: application/json"]
        lines += [f"Idempotency-Key: {key}"] if key else []
        reader, writer = await asyncio.open_connection(self._host, self._port)
        writer.write("\r\n".join([*lines, "", ""]).encode() + body)
        answer = await reader.read()
        writer.close()
        head, _, rest = answer.partition(b"\r\n\r\n")
        first, *fields = head.decode().split("\r\n")
        return int(first.split()[1]), {f.split(": ")[0].lower(): f.split(": ")[1] for f in fields}, rest


@pytest.mark.slow
def test_a_thousand_at_once_are_all_served_and_nothing_is_lost_or_started_twice(
    tmp_path: Path, manifest: Any, many_files: None
) -> None:
    program = Program(tmp_path / "state", "--stop-instances")
    try:
        with with_toy(program.start(), manifest) as client:
            client.create_site(SiteCreate(name="small", tier="edge", runtime="process", options={"cpu": 0.03}))
            client.delete_site("local")
            url = (program.folder / "address").read_text().strip()
            asyncio.run(_crowd(url, (program.folder / "operator.token").read_text().strip()))
            until(lambda: sum(i.state is State.RUNNING for i in client.instances()) == 3, program)
            held = client.instances()
            assert len(held) == MANY + 1
            assert len(program.services()) == 3  # as many as fit; the others wait
            assert sum(i.state in (State.PENDING, State.PLACING) for i in held) == MANY - 2
        process = program.process
        assert process is not None
        process.terminate()
        assert process.wait(4 * PATIENCE) == 0
        assert program.services() == set()
    finally:
        program.clean_up()


async def _crowd(url: str, token: str) -> None:
    caller = Caller(url, token)
    asked = [{"robot": f"robot-{n}", "service": "toy", "lease_s": 600} for n in range(MANY)]
    posts = (caller.ask("POST", "/instances", one, one["robot"]) for one in asked)  # type: ignore[arg-type]
    made = {one["id"] for one in await asyncio.gather(*posts)}
    assert len(made) == MANY

    double = {"robot": "double", "service": "toy", "lease_s": 600}
    same = await asyncio.gather(*(caller.ask("POST", "/instances", double, "same") for _ in range(MANY)))
    assert len({one["id"] for one in same}) == 1

    paths = [f"/instances/{one}" for one in made]
    calls = (caller.ask("GET", p) if n % 4 else caller.ask("POST", f"{p}/renew", {}) for n, p in enumerate(paths))
    assert {one["id"] for one in await asyncio.gather(*calls)} == made
    assert caller.statuses <= {200, 201, 503}
