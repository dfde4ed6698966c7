"""``/catalog``: what robots can ask for."""

from __future__ import annotations

from fastapi import APIRouter, Response

from skytether.api.manifest import Manifest
from skytether.api.rest import CHANGE, Change

from .deps import PREFIX, Caller, CatalogOperator, Core, says

router = APIRouter(prefix=f"{PREFIX}/catalog", tags=["catalog"], responses=says(401))


@router.get("")
def list_services(core: Core, caller: Caller) -> list[Manifest]:
    """All services; a robot sees those that it may ask for."""
    return [manifest for manifest in core.catalog.all() if caller.may_use(manifest.metadata.name)]


@router.get("/{service}", responses=says(403, 404))
def get_service(core: Core, caller: Caller, service: str) -> Manifest:
    """One service's manifest."""
    caller.require(caller.robot or "", service)
    return core.catalog.get(service)


@router.put("/{service}", responses={201: {"model": Manifest, "description": "It is new"}, **says(403, 422)})
def put_service(
    core: Core, caller: CatalogOperator, service: str, manifest: Manifest, response: Response, dry_run: bool = False
) -> Manifest:
    """Add a service, or change it for instances to come; the header Skytether-Change says which, or `unchanged`.

    With `dry_run` it is only looked at: the answer is the same, but the status is never 201.
    """
    change = core.catalog.put(service, manifest, dry_run=dry_run, by_owner=caller.owns_state)
    response.headers[CHANGE] = change
    if change is Change.CREATED and not dry_run:
        response.status_code = 201
    return manifest


@router.delete("/{service}", status_code=204, responses=says(403, 409))
def delete_service(core: Core, _: CatalogOperator, service: str) -> None:
    """Remove a service that was put; its instances run on."""
    core.catalog.delete(service)
    core.metrics.forget_service(service)
