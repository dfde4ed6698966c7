"""The HTTP interface of an orchestrator that runs already. Nothing is opened or started here."""

from __future__ import annotations

from fastapi import Depends, FastAPI
from fastapi.telemetry import TelemetryConfig

import skytether

from . import problems
from .core import Orchestrator
from .logs import Audit
from .reception import Reception
from .routers import catalog, health, instances, robots, sites, tokens
from .routers.deps import plain_request

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
    )
    app.state.core = core
    problems.install(app)
    for router in (catalog.router, sites.router, instances.router, robots.router, tokens.router, health.router):
        app.include_router(router)
    app.add_middleware(Reception, doorman=core, limits=core.settings.limits, strain=core.strain)
    app.add_middleware(Audit)
    return app
