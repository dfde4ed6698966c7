"""What machines ask: is it up, can it work, what does it measure."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response
from fastapi.responses import PlainTextResponse
from prometheus_client import CONTENT_TYPE_LATEST

from skytether.api.rest import ScrapeTargets

from ..problems import answer
from .deps import PREFIX, Bearer, Core, authenticated, says

router = APIRouter(tags=["health"])


@router.get("/healthz", response_class=PlainTextResponse)
async def healthz() -> str:
    """The process answers."""
    return "ok\n"


@router.get("/readyz", response_class=PlainTextResponse, responses=says(503))
def readyz(core: Core, request: Request) -> Response:
    """It can do its work: the database answers, and the reconciler makes its passes."""
    why = core.not_ready()
    return answer(request, 503, "Not ready", why) if why else PlainTextResponse("ready\n")


@router.get(f"{PREFIX}/prometheus/targets", responses=says(401, 403))
def prometheus_targets(core: Core, request: Request, token: Bearer) -> list[ScrapeTargets]:
    """For the HTTP service discovery of Prometheus (`http_sd_configs`): the orchestrators over this database."""
    _may_measure(core, request, token)
    return core.scrape_targets(f"{request.url.scheme}://{request.url.netloc}")


@router.get("/metrics", response_class=PlainTextResponse, responses=says(401, 403))
def metrics(core: Core, request: Request, token: Bearer) -> Response:
    """Prometheus metrics; for the operator, or for all if the orchestrator was started with ``--open-metrics``."""
    _may_measure(core, request, token)
    return Response(core.metrics.text(), media_type=CONTENT_TYPE_LATEST)


def _may_measure(core: Core, request: Request, token: Bearer) -> None:
    if not core.settings.open_metrics:
        authenticated(core, request, token).require_scope("metrics")
