"""``/groups``: sites that are made and destroyed as they are needed."""

from __future__ import annotations

from fastapi import APIRouter, Response

from skytether.api.groups import Group, GroupCreate, GroupEvent, Machine

from ...core import Orchestrator
from ...scheduling.instances import utc
from ...store.group_store import GroupRow
from .deps import PREFIX, Core, Reader, SitesOperator, made, says

router = APIRouter(prefix=f"{PREFIX}/groups", tags=["groups"])


def _show(core: Orchestrator, row: GroupRow) -> Group:
    group = core.groups.find(row.name)
    offer = group.offer if group else None
    machines = tuple(
        Machine(
            name=one.name,
            stage=one.stage,
            id=one.provided,
            since=utc(one.since),
            instances=len(core.store.live_at(one.name)),
            reason=one.reason,
        )
        for one in core.store.machines(row.name)
    )
    return Group(
        **dict(row.asked),
        draining=row.draining,
        reason=(group.obstacle if group else "") or row.reason,
        retry_at=utc(row.retry_at) if row.failures else None,
        cpu=offer.cpu if offer else None,
        memory_mb=offer.memory_mb if offer else None,
        machines=machines,
        events=tuple(GroupEvent(at=utc(at), text=text) for at, text in reversed(row.told)),
    )


@router.get("", responses=says(401, 403))
def list_groups(core: Core, _: Reader) -> list[Group]:
    """All groups, with their machines."""
    return [_show(core, row) for row in core.store.site_groups()]


@router.post("", status_code=201, responses=says(401, 403, 409, 422))
def create_group(core: Core, caller: SitesOperator, asked: GroupCreate, response: Response) -> Group:
    """Add a group; it makes machines, so only the token in the state folder may."""
    group = core.groups.add(asked, by_owner=caller.owns_state)
    made(response, "groups", group.name)
    return _show(core, GroupRow(group.asked, group.owner))


@router.get("/{group}", responses=says(401, 403, 404))
def get_group(core: Core, _: Reader, group: str) -> Group:
    """One group."""
    return _show(core, core.groups.row(group))


@router.delete(
    "/{group}",
    status_code=204,
    responses={202: {"description": "Its machines are being given back"}, **says(401, 403, 404, 409)},
)
def delete_group(core: Core, caller: SitesOperator, group: str, drain: bool = False) -> Response:
    """Forget a group without machines.

    With ``drain`` one that has some moves what runs there, gives them back (202), and is forgotten with the last one.
    """
    gone = core.groups.delete(group, drain=drain, by_owner=caller.owns_state)
    return Response(status_code=204 if gone else 202)
