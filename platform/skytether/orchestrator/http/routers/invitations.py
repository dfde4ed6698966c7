"""``/invitations``: tokens with which machines join; each is shown once, when it is made."""

from __future__ import annotations

from fastapi import APIRouter, Response

from skytether.api.rest import Invitation, Invite, SiteCreate

from ...domain.errors import ConflictError
from ...nodes.enrolment import RUNTIME
from ...scheduling.instances import utc
from .deps import PREFIX, Core, SitesOperator, made, says

router = APIRouter(prefix=f"{PREFIX}/invitations", tags=["sites"])


@router.post("", status_code=201, responses=says(401, 403, 409, 422))
def invite(core: Core, caller: SitesOperator, asked: Invite, response: Response) -> Invitation:
    """Make a token with which one machine may join as a site, once; one for the same name that was not used ends."""
    if core.nodes is None or core.settings.nodes.port is None:
        raise ConflictError(
            "no machine can join this orchestrator: set nodes.port (SKYTETHER_NODES_PORT=8603), and nodes.host to an "
            "address that they reach"
        )
    site = SiteCreate(runtime=RUNTIME, **asked.model_dump(exclude={"ttl_s"}))
    invitation, token = core.nodes.invite(site, asked.ttl_s, caller.owner, by_owner=caller.owns_state)
    made(response, "invitations", f"{invitation.id}/{site.name}")
    return Invitation(
        id=invitation.id,
        name=site.name,
        token=token,
        expires_at=utc(invitation.expires_at),
        urls=core.settings.nodes.urls,
        port=core.node_port or core.settings.nodes.port,
    )
