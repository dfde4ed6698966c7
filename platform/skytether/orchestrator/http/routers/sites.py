"""``/sites``: where instances can run."""

from __future__ import annotations

import time
from collections.abc import Mapping

from fastapi import APIRouter, Response

from skytether.api.rest import NodeState, Site, SiteCreate, Unfit

from ...access.access import Principal
from ...core import Orchestrator
from ...scheduling.instances import utc
from ...scheduling.site import Site as LiveSite
from ...store.node_rows import Node
from .deps import PREFIX, Caller, Core, SitesOperator, made, says

router = APIRouter(prefix=f"{PREFIX}/sites", tags=["sites"])


def _show(core: Orchestrator, site: LiveSite, caller: Principal, nodes: Mapping[str, Node]) -> Site:
    asked, total = site.asked, site.capacity
    unreachable, blocked = site.unreachable, site.runtime.blocked()
    return Site(
        name=asked.name,
        tier=asked.tier,
        runtime=asked.runtime,
        options=asked.options if caller.robot is None else {},  # how to reach an engine is no robot's business
        speed=asked.speed,
        cost=asked.cost,
        images=asked.images,
        state="unreachable" if unreachable else "blocked" if blocked else "ready",
        reason=unreachable or blocked,
        isolation=site.runtime.isolation() if caller.robot is None else (),
        cpu=total.cpu if total else None,
        memory_mb=total.memory_mb if total else None,
        gpu=total.gpu if total else None,
        architecture=total.architecture if total else "",
        load=site.load,
        instances=len(core.store.live_at(asked.name)),
        unfit=_unfit(site) if caller.robot is None else (),
        draining=site.draining,
        evacuating=site.evacuating,
        node=_node(nodes[asked.name]) if asked.name in nodes and caller.robot is None else None,
    )


def _nodes(core: Orchestrator) -> Mapping[str, Node]:
    return core.nodes.all() if core.nodes is not None else {}


def _node(node: Node) -> NodeState:
    return NodeState(
        joined_at=utc(node.joined_at),
        seen_at=utc(node.seen_at),
        seen_as=node.seen_as,
        certificate_until=utc(node.ends_at),
        **node.machine.model_dump(exclude={"id"}),
    )


def _unfit(site: LiveSite) -> tuple[Unfit, ...]:
    return tuple(
        Unfit(
            service=verdict.service,
            reason=verdict.why,
            failures=verdict.failures,
            robots=tuple(sorted(verdict.robots)),
            until=utc(verdict.again_at),
        )
        for verdict in site.fitness.verdicts(time.monotonic())
    )


@router.get("", responses=says(401))
def list_sites(core: Core, caller: Caller) -> list[Site]:
    """All sites; a robot does not see their options."""
    nodes = _nodes(core)
    return [_show(core, site, caller, nodes) for site in core.sites.all()]


@router.post("", status_code=201, responses=says(401, 403, 409, 422))
def create_site(core: Core, caller: SitesOperator, asked: SiteCreate, response: Response) -> Site:
    """Add a site."""
    site = core.sites.add(asked, by_owner=caller.owns_state)
    made(response, "sites", site.name)
    return _show(core, site, caller, {})


@router.get("/{site}", responses=says(401, 404))
def get_site(core: Core, caller: Caller, site: str) -> Site:
    """One site."""
    return _show(core, core.sites.get(site), caller, _nodes(core))


@router.post("/{site}/drain", responses=says(401, 403, 404))
def drain_site(core: Core, caller: SitesOperator, site: str) -> Site:
    """Have a site take no more instances, and move those that are there elsewhere, before it is updated, say."""
    core.sites.evacuate(site)
    return _show(core, core.sites.get(site), caller, _nodes(core))


@router.post("/{site}/resume", responses=says(401, 403, 404, 409))
def resume_site(core: Core, caller: SitesOperator, site: str) -> Site:
    """Have a site that was drained take instances again."""
    core.sites.evacuate(site, False)
    return _show(core, core.sites.get(site), caller, _nodes(core))


@router.delete(
    "/{site}", status_code=204, responses={202: {"description": "It is being drained"}, **says(401, 403, 404, 409)}
)
def delete_site(core: Core, _: SitesOperator, site: str, drain: bool = False, force: bool = False) -> Response:
    """Forget a site that has no instances. No certificate of a machine that joined as it is good any more.

    With ``drain`` one that has some takes no more (202), and is forgotten when the last of them has ended or was moved.
    With ``force`` it is forgotten at once, whatever is there: for a machine that is gone for good.
    """
    if force or not drain:
        core.sites.delete(site, force=force)
    elif not core.sites.drain(site):
        return Response(status_code=202)
    core.metrics.forget_site(site)
    return Response(status_code=204)


@router.get("/{site}/probe", status_code=204, responses=says(401, 403, 404))
async def probe(core: Core, _: Caller, site: str) -> Response:
    """Answer at once, so that a robot can measure its round trip: no database after the first, no thread, no body."""
    core.sites.get(site)
    return Response(status_code=204)
