"""What becomes of a request before it is served: in order, bounded, and nobody at another one's cost."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import threading
import weakref
from typing import Any

import pytest

from skytether.orchestrator.access.access import Principal
from skytether.orchestrator.config.settings import ServerLimits
from skytether.orchestrator.domain.errors import UnauthenticatedError
from skytether.orchestrator.domain.overload import Overload
from skytether.orchestrator.http.admission import RUN, Admission
from skytether.orchestrator.http.problems import GivenUp
from skytether.orchestrator.http.refusal_delay import RefusalDelay

RENEWAL = "/api/v1/instances/i1/renew"
OTHER = "/api/v1/instances"


class Knows:
    """Knows each token as the robot of that name, and ``operator``."""

    def __init__(self) -> None:
        self.lately: dict[str, Principal] = {}
        self.spent: list[str] = []
        self.verified: list[str | None] = []

    def authenticate(self, token: str | None, address: str) -> Principal:
        if not token:
            raise UnauthenticatedError("a token is needed")
        return Principal(None, scopes=frozenset()) if token == "operator" else Principal(token)

    def recent(self, token: str | None, address: str) -> Principal | None:
        return self.lately.get(token or "")

    def spend(self, caller: Principal) -> None:
        self.spent.append(caller.owner)

    def verify(self, token: str | None) -> Principal:
        self.verified.append(token)
        return self.authenticate(token, "")

    def charge(self, caller: Principal, length: int) -> None:
        pass


class Scene:
    """A admission before an app that answers when it is told to."""

    def __init__(self, pause_s: float = 0.0, **limits: Any) -> None:
        self.go = asyncio.Event()
        self.read: list[bytes] = []
        self.now = 0.0
        self.overload = Overload(lambda: self.now)
        self.knows = Knows()
        self.renewed: list[float] = []
        self.admission = Admission(
            self.app, self.knows, ServerLimits(**limits), self.overload, RefusalDelay(pause_s), self.renewed.append
        )

    async def app(self, scope: Any, receive: Any, send: Any) -> None:
        self.read.append((await receive())["body"])
        await self.go.wait()
        if scope["path"] == RENEWAL:
            await scope["state"][RUN](self.read.append, b"renewed")
        if scope["path"].endswith("broken"):
            raise ValueError
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def ask(
        self, path: str = OTHER, token: str = "operator", body: list[bytes] | None = None, declares: int | None = None
    ) -> tuple[int, dict[bytes, bytes]]:
        """Status and headers; without a body it never comes."""
        chunks = [b""] if body is None else list(body)
        told: list[Any] = []

        async def receive() -> dict[str, Any]:
            if not chunks:
                await asyncio.Event().wait()
            return {"type": "http.request", "body": chunks.pop(0), "more_body": bool(chunks) or not body}

        async def whole() -> dict[str, Any]:
            return {"type": "http.request", "body": b"", "more_body": False}

        async def send(message: Any) -> None:
            told.append(message)

        headers = [(b"authorization", f"Bearer {token}".encode())] if token else []
        headers += [(b"content-length", str(declares).encode())] if declares else []
        scope = {"type": "http", "path": path, "method": "POST", "headers": headers, "query_string": b""}
        await self.admission(scope, whole if body is None else receive, send)
        return next((m["status"], dict(m["headers"])) for m in told if "status" in m)


def run(scene: Any) -> None:
    asyncio.run(asyncio.wait_for(scene(), 30))


async def settle() -> None:
    for _ in range(50):
        await asyncio.sleep(0.002)


def test_beyond_the_bound_they_are_told_to_come_again_and_renewals_have_room_of_their_own() -> None:
    async def scene() -> None:
        at = Scene(requests_at_once=3, requests_for_renewals=1)
        waiting = [asyncio.create_task(at.ask()), asyncio.create_task(at.ask("/api/broken"))]
        await settle()
        status, headers = await at.ask()
        assert (status, headers[b"retry-after"]) == (503, b"1")
        assert not at.overload.felt()
        renewing = asyncio.create_task(at.ask(RENEWAL, "walker"))
        await settle()
        assert (await at.ask(RENEWAL, "runner"))[0] == 503
        assert at.overload.felt()
        free = asyncio.create_task(at.ask("/healthz", ""))
        at.go.set()
        assert (await renewing)[0] == (await free)[0] == 200
        assert isinstance((await asyncio.gather(*waiting, return_exceptions=True))[1], ValueError)
        assert [(await at.ask())[0] for _ in range(4)] == [200] * 4

    run(scene)


def test_nothing_is_read_of_a_body_before_its_sender_is_known_and_none_takes_a_place_before_it_is_there() -> None:
    async def scene() -> None:
        at = Scene(requests_at_once=2, requests_for_renewals=1, robot_requests_at_once=2)
        at.go.set()
        assert (await at.ask(token="", body=[]))[0] == 401
        slow = [asyncio.create_task(at.ask(token=f"r{n}", body=[])) for n in range(20)]
        await settle()
        assert (await at.ask(body=[b"whole"]))[0] == 200
        again = asyncio.create_task(at.ask(token="r0", body=[]))
        await settle()
        assert (await at.ask(token="r0"))[0] == 429
        for one in (*slow, again):
            one.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.gather(*slow, again)
        assert (await at.ask(token="r0"))[0] == 200
        assert at.read == [b"whole", b""]

    run(scene)


def test_who_is_a_stranger_or_asks_too_often_waits_for_the_answer_and_nobody_else_does() -> None:
    async def scene() -> None:
        at = Scene(pause_s=1000.0, robot_requests_at_once=1)
        under_way = asyncio.create_task(at.ask(token="r0", body=[]))
        await settle()
        refused = [
            asyncio.create_task(one)
            for one in (at.ask(token=""), at.ask(token="r0"), at.ask("/api/v1/instances/../x"), at.ask("/no"))
        ]
        at.go.set()
        await settle()
        assert [one.done() for one in refused] == [False, False, False, True], "the last is served"
        assert (await at.ask(token="r1"))[0] == (await at.ask(RENEWAL, "r2"))[0] == 200
        for one in (under_way, *refused):
            one.cancel()

    run(scene)


def test_however_many_connections_are_refused_at_once_some_hundred_are_in_a_second() -> None:
    async def scene() -> None:
        pause = RefusalDelay(0.25)
        assert pause.next_s == 0.25
        refused = [asyncio.create_task(pause.wait()) for _ in range(640)]
        await asyncio.sleep(0)
        assert pause.next_s == pytest.approx(0.25 * 11)
        refused += [asyncio.create_task(pause.wait()) for _ in range(600)]
        await asyncio.sleep(0)
        assert pause.next_s == 5.0
        for one in refused:
            one.cancel()
        await asyncio.gather(*refused, return_exceptions=True)
        assert pause.next_s == 0.25

    run(scene)


def test_tokens_that_nobody_knows_keep_no_renewal_waiting() -> None:
    """They are looked up in threads of their own; who was known a moment ago is asked again in the renewal's."""

    async def scene() -> None:
        at = Scene()
        at.go.set()
        looking, found = threading.Event(), threading.Event()

        def slowly(token: str | None, address: str) -> Principal:
            looking.set()
            found.wait(30)
            raise UnauthenticatedError("unknown")

        at.knows.lately["walker"] = Principal("walker")
        at.knows.authenticate = slowly  # type: ignore[method-assign]
        at.knows.verify = lambda token: at.knows.verified.append(token) or Principal(token)  # type: ignore[method-assign, func-returns-value]
        strangers = [asyncio.create_task(at.ask(RENEWAL, f"made-up-{n}")) for n in range(50)]
        await asyncio.to_thread(looking.wait, 30)
        assert (await at.ask(RENEWAL, "walker"))[0] == 200
        assert at.knows.spent == ["robot:walker"]
        assert at.knows.verified == ["walker"]
        assert at.read == [b"", b"renewed"]
        assert len(at.renewed) == 1
        found.set()
        assert {status for status, _ in await asyncio.gather(*strangers)} == {401}
        assert len(at.renewed) == 1

    run(scene)


def test_a_refusal_leaves_nothing_that_waits_for_the_collector() -> None:
    class UnknownError(UnauthenticatedError):
        pass

    left: list[weakref.ref[UnknownError]] = []

    def unknown(token: str | None, address: str) -> Principal:
        error = UnknownError("unknown")
        left.append(weakref.ref(error))
        try:
            raise error
        finally:
            del error

    async def scene() -> None:
        at = Scene()
        at.knows.authenticate = unknown  # type: ignore[method-assign]
        assert (await at.ask(token="made-up"))[0] == 401
        await settle()  # the thread forgets it at its next turn
        assert [error() for error in left] == [None]

    gc.disable()
    try:
        run(scene)
    finally:
        gc.enable()


def test_a_body_is_bounded_whether_it_says_so_or_not_and_a_robots_is_smaller() -> None:
    async def scene() -> None:
        at = Scene(body_bytes=100, robot_body_bytes=10)
        at.go.set()
        assert (await at.ask(body=[b"a" * 60, b"a" * 40]))[0] == 200
        assert (await at.ask(body=[b"a" * 60, b"a" * 41]))[0] == 413
        assert (await at.ask(body=[], declares=101))[0] == 413
        assert (await at.ask(token="walker", body=[b"a" * 11]))[0] == 413
        assert at.read == [b"a" * 100]

    run(scene)


def test_who_needs_no_token_takes_no_place_of_those_who_have_one() -> None:
    async def scene() -> None:
        at = Scene(requests_at_once=2, requests_for_renewals=1)
        waiting = [asyncio.create_task(at.ask("/readyz", "", body=[])) for _ in range(30)]
        await settle()
        assert sum(one.done() for one in waiting) == 14  # 503
        served = asyncio.create_task(at.ask())
        await settle()
        at.go.set()
        assert (await served)[0] == 200
        await asyncio.gather(*waiting)

    run(scene)


def test_a_renewal_for_which_there_is_no_room_is_felt_as_strain() -> None:
    """As long as the orchestrator itself refuses, no lease runs out."""

    async def scene() -> None:
        at = Scene()
        assert at.admission.hold(64 << 20)
        assert (await at.ask(body=[b"whole"]))[0] == 503
        assert not at.overload.felt()
        assert (await at.ask(RENEWAL, "walker", body=[b"whole"]))[0] == 503
        assert at.overload.felt()

    run(scene)


def test_who_still_waits_when_an_orchestrator_ends_is_told_to_ask_again() -> None:
    sent: list[Any] = []

    async def hangs(*_: Any) -> None:
        await asyncio.Event().wait()

    async def send(message: Any) -> None:
        sent.append(message)

    async def nothing() -> Any:
        return {}

    async def ended() -> None:
        scope = {"type": "http", "method": "POST", "path": "/x", "query_string": b"", "headers": []}
        asking = asyncio.ensure_future(GivenUp(hangs)(scope, nothing, send))
        await asyncio.sleep(0)
        asking.cancel()
        await asking

    asyncio.run(ended())
    assert sent[0]["status"] == 503
    assert (b"retry-after", b"2") in sent[0]["headers"]
    assert b"ask again" in sent[1]["body"]


@pytest.mark.parametrize(
    ("headers", "ends"), [([(b"content-type", b"text/event-stream")], True), ([(b"Content-Length", b"9")], False)]
)
def test_a_stream_that_an_orchestrator_has_no_time_for_ends_and_a_part_of_an_answer_is_none(
    headers: list[tuple[bytes, bytes]], ends: bool
) -> None:
    sent: list[Any] = []

    async def tells(_: Any, __: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": b"one", "more_body": True})
        await asyncio.Event().wait()

    async def send(message: Any) -> None:
        sent.append(message)

    async def nothing() -> Any:
        return {}

    async def ended() -> None:
        telling = asyncio.ensure_future(GivenUp(tells)({"type": "http"}, nothing, send))
        await asyncio.sleep(0)
        telling.cancel()
        with contextlib.nullcontext() if ends else pytest.raises(asyncio.CancelledError):
            await telling

    asyncio.run(ended())
    assert len(sent) == (3 if ends else 2)
    assert not (ends and sent[-1].get("more_body"))
