"""The HTTP interface of an orchestrator that runs already. Nothing is opened or started here."""

from __future__ import annotations

from fastapi import Depends, FastAPI
from fastapi.telemetry import TelemetryConfig

import skytether

from ..core import Orchestrator
from ..telemetry.logs import Audit
from . import docs_page, problems
from .admission import Admission
from .refusal_delay import RefusalDelay
from .routers import catalog, groups, health, instances, invitations, robots, sites, tokens
from .routers.deps import plain_request
from .trusted_hosts import TrustedHosts, own_names

_NO_TELEMETRY: TelemetryConfig = {"tracing": False, "metrics": False, "logs": False}
"""FastAPI's own (OpenTelemetry) costs each request a twentieth, even where nobody exports it."""


def create_app(core: Orchestrator) -> FastAPI:
    """An ASGI app over an orchestrator; whoever serves it starts and stops the orchestrator."""
    app = FastAPI(
        title="Skytether",
        version=skytether.__version__,
        description="Ask for services for robots; see what runs where, and how well.",
        dependencies=[Depends(plain_request)],
        telemetry=_NO_TELEMETRY,
        redirect_slashes=False,  # a name that is empty is none, and not another request
        docs_url=None,  # FastAPI's own loads scripts from a public host
        redoc_url=None,
    )
    app.state.core = core
    problems.install(app)
    for part in (catalog, sites, groups, invitations, instances, robots, tokens, health, docs_page):
        app.include_router(part.router)
    refusal_delay = RefusalDelay()
    app.add_middleware(
        Admission,
        authenticator=core,
        limits=core.settings.limits,
        overload=core.overload,
        refusal_delay=refusal_delay,
        on_renewed=core.metrics.renewed,
    )
    app.add_middleware(problems.GivenUp)
    app.add_middleware(Audit)
    app.add_middleware(TrustedHosts, names=own_names(core.settings), refusal_delay=refusal_delay)
    return app
