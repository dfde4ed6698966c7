"""``/instances``: ask for a service, keep it, watch it, end it."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Annotated

from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Depends, Header, Query, Request, Response
from fastapi.responses import PlainTextResponse, StreamingResponse
from fastapi.sse import EventSourceResponse, ServerSentEvent

from skytether.api.pull_progress import PullProgress
from skytether.api.rest import (
    Instance,
    InstanceCreate,
    InstanceEvent,
    Migrate,
    Neighbours,
    Renew,
    Resize,
    SessionClaim,
    SessionKey,
    Share,
)

from ...core import Orchestrator
from ...domain.records import Record
from ...runtimes.base import LogStream
from ...scheduling.instances import utc
from ...store.engine import GONE
from ...store.store import EventRow
from .deps import PREFIX, Actor, Caller, Core, InstancesOperator, InThread, KeyHolder, made, says

router = APIRouter(prefix=f"{PREFIX}/instances", tags=["instances"], responses=says(401))

_LOOK = 1.0
"""Seconds between two looks for events that another replica of the orchestrator may have stored."""


@router.post("", status_code=201, responses=says(403, 404, 409, 422))
def create(
    core: Core,
    caller: Actor,
    asked: InstanceCreate,
    response: Response,
    idempotency_key: Annotated[str | None, Header(min_length=1, max_length=255)] = None,
) -> Instance:
    """Ask for a service. The same request with the same Idempotency-Key is answered with the instance made first."""
    record = core.instances.create(caller, asked, idempotency_key)
    made(response, "instances", record.id)
    return core.instances.show(record)


@router.get("")
def list_instances(core: Core, caller: Caller) -> list[Instance]:
    """Newest first, without sessions; a robot sees its own."""
    return [core.instances.outline(record) for record in core.instances.all(caller)]


def _own(core: Core, caller: Caller, instance: str) -> Record:
    return core.instances.get(caller, instance)


async def _watching(core: Core, caller: Caller) -> AsyncIterator[None]:
    with core.quotas.stream(caller):
        yield


async def _following(core: Core, caller: Caller, *, follow: bool = False) -> AsyncIterator[None]:
    if not follow:
        yield
        return
    with core.quotas.stream(caller, log=True):
        yield


Own = Annotated[Record, Depends(_own)]
"""The instance of the address, if the caller may see it."""


@router.get("/{instance}", responses=says(404))
def get(core: Core, caller: Caller, instance: str) -> Instance:
    """One instance with its session."""
    return core.instances.show(core.instances.get(caller, instance))


@router.delete("/{instance}", status_code=204, responses=says(404))
def delete(core: Core, caller: Actor, instance: str) -> None:
    """End an instance; may be called again."""
    core.instances.delete(caller, instance)


@router.patch("/{instance}", responses=says(403, 404, 409, 422, 503))
def resize(core: Core, caller: InstancesOperator, instance: str, asked: Resize) -> Instance:
    """Give a running instance more or less, without a restart; ``resize`` of it says so until it has it.

    Where its site cannot, another one is started that can (``successor``), and its robot changes to that.
    """
    return core.instances.show(core.instances.resize(caller, instance, asked))


@router.post("/{instance}/renew", responses=says(404, 422))
async def renew(core: Core, caller: Actor, run: InThread, instance: str, asked: Renew) -> Instance:
    """Keep the lease, and report how well it goes; look at the answer's state, for what has ended stays ended."""
    renewed: Instance = await run(core.instances.renew, caller, instance, asked)
    return renewed


@router.post("/{instance}/share", responses=says(403, 404, 409, 422))
def share(core: Core, caller: Actor, instance: str, asked: Share) -> Neighbours:
    """Tell what the instance's service shares with the robot's group, and hear what others do; of its robot only."""
    return core.shared_topics.share(caller, core.instances.get(caller, instance), asked)


@router.post("/{instance}/session", responses=says(403, 404, 409, 422))
def claim_session(core: Core, caller: KeyHolder, instance: str, asked: SessionClaim) -> SessionKey:
    """The key of the instance's session. Its robot gets it once: again with the same claim only."""
    return core.instances.claim_session(caller, instance, asked.claim)


@router.post("/{instance}/migrate", status_code=201, responses=says(403, 404, 409, 422))
def migrate(core: Core, caller: Actor, instance: str, asked: Migrate, response: Response) -> Instance:
    """Move an instance: another is started elsewhere; its robot changes to that once it runs, and lets this one go."""
    record = core.instances.migrate(caller, instance, asked)
    made(response, "instances", record.id)
    return core.instances.show(record)


@router.get(
    "/{instance}/logs",
    response_class=PlainTextResponse,
    responses=says(404, 429, 503),
    dependencies=[Depends(_following)],  # until the answer has ended, however it does
)
async def logs(
    core: Core,
    caller: Caller,
    request: Request,
    instance: str,
    tail: Annotated[int, Query(ge=1)] = 200,
    follow: bool = False,
) -> Response:
    """The last lines that the instance wrote, over all its runs.

    With ``follow`` those of its present run, then what that writes as it comes, until it ends.
    """
    lines = min(tail, core.settings.limits.log_lines)
    record = await to_thread.run_sync(core.instances.get, caller, instance)
    stream = await to_thread.run_sync(core.instances.follow, caller, instance, lines) if follow else None
    if stream is None:
        return PlainTextResponse(await to_thread.run_sync(core.instances.logs, caller, instance, lines))
    return StreamingResponse(_relayed(core, request, stream, record), media_type="text/plain")


async def _relayed(core: Orchestrator, request: Request, stream: LogStream, record: Record) -> AsyncIterator[str]:
    """Until the run ends, nobody listens any more, or the orchestrator is to end."""
    readers = CapacityLimiter(
        1
    )  # a thread for each, of which quotas.log_streams is the bound: others' are not waited for
    try:
        while not core.broker.closed and not await request.is_disconnected():
            text = await to_thread.run_sync(stream.read, limiter=readers)
            if text is None:
                return
            if text:
                yield text
            elif await to_thread.run_sync(_is_over, core, record):
                return
    finally:
        stream.close()


def _is_over(core: Orchestrator, record: Record) -> bool:
    """Whether a run has ended, for whoever leads knows it first, and not every orchestrator sees every site's runs."""
    with contextlib.suppress(*GONE):
        now = core.store.get(record.id)
        return now is None or now.state.final or now.attempt != record.attempt
    return False


@router.get(
    "/{instance}/events",
    response_class=EventSourceResponse,
    responses=says(404, 429),
    dependencies=[Depends(_watching)],
)
async def events(
    core: Core, record: Own, last_event_id: Annotated[int, Header(ge=0)] = 0
) -> AsyncIterator[ServerSentEvent]:
    """All events so far after ``Last-Event-ID``, then each as it comes; the stream ends with the instance."""
    last, ended = last_event_id, False
    with core.broker.subscribe(record.id) as changed:
        while not core.broker.closed:
            changed.clear()
            rows: list[EventRow] = []
            with contextlib.suppress(*GONE):  # the next look tells what this one could not
                rows, ended = await to_thread.run_sync(_news, core, record.id, last)
            for row in rows:
                last = row.id
                event = InstanceEvent(
                    id=row.id,
                    instance=row.instance,
                    at=utc(row.at),
                    state=row.state,
                    reason=row.reason,
                    code=row.code,
                    pull=PullProgress.model_validate(row.pull) if row.pull else None,
                )
                yield ServerSentEvent(id=str(row.id), event="report" if row.code else "state", data=event)
            if ended:
                return
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(changed.wait(), _LOOK)


def _news(core: Orchestrator, instance: str, after: int) -> tuple[list[EventRow], bool]:
    """Events after one, and whether no more will come; asked in the order that makes this true."""
    record = core.store.get(instance)
    return core.store.events(instance, after), record is None or record.state.final
