"""A Docker engine as the only site of a trial, or of a benchmark, and nothing left of it there afterwards."""

from __future__ import annotations

import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from skytether.api.client import Client
from skytether.api.rest import SiteCreate
from skytether.orchestrator.runtimes.base import RuntimeFailure
from skytether.orchestrator.runtimes.docker.engine import Engine
from skytether.orchestrator.runtimes.docker.fence import remove_volume
from skytether.orchestrator.runtimes.docker.network import remove_network
from skytether.orchestrator.runtimes.docker.objects import OWNER
from skytether.orchestrator.runtimes.docker.options import DockerOptions

from .errors import TrialError
from .scenario import TrialSettings


@contextmanager
def engine_site(given: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """The options of a site of one's own; what is left there is removed in the end, when no orchestrator runs any more.

    An orchestrator that ends leaves what its services wrote, and what tells of them: the next one wants it. After a
    trial there is no next one.

    Args:
        given: Options; ``owner`` and ``network`` are made up where they are not among them.

    Raises:
        TrialError: It could not be removed.
    """
    owner = given.get("owner", f"trial-{secrets.token_hex(4)}")
    options = {"owner": owner, "network": f"skytether-{owner}", **given}
    try:
        yield options
    finally:
        try:
            remove_all(options)
        except RuntimeFailure as error:
            raise TrialError(f"what the trial made could not be removed from the engine: {error}") from error


def remove_all(options: Mapping[str, Any]) -> None:
    """Remove a site's containers and volumes, the services' data too, and its network, if nobody else is in there.

    Raises:
        RuntimeFailure: The engine does not answer, or refuses.
    """
    valid = DockerOptions.model_validate(options)
    engine = Engine(valid)
    mine = {"label": f"{OWNER}={valid.owner}"}
    try:
        with engine.asked():
            api = engine.api()
            for container in api.containers(all=True, filters=mine):
                api.remove_container(container["Id"], v=True, force=True)
            for volume in api.volumes(mine)["Volumes"] or ():
                remove_volume(engine, volume["Name"])
        remove_network(engine, valid)
    finally:
        engine.drop()


def use_engine(operator: Client, service: str, settings: TrialSettings, options: Mapping[str, Any]) -> None:
    """Make the engine the only site, and have the service run there as the scenario wants it.

    Raises:
        skytether.api.client.ApiError: The options are refused.
    """
    manifest = operator.get_service(service)
    changes: dict[str, Any] = {"image": settings.image} if settings.image else {}
    if cpu := settings.scenario.cpu:  # the engine's quota of processor time
        changes["needs"] = manifest.spec.needs.model_copy(update={"cpu": min(manifest.spec.needs.cpu, cpu)})
        changes["limits"] = manifest.spec.limits.model_copy(update={"cpu": cpu})
    if changes:
        spec = manifest.spec.model_copy(update=changes)
        operator.put_service(service, manifest.model_copy(update={"spec": spec}))
    operator.create_site(SiteCreate(name="docker", tier="edge", runtime="docker", options=dict(options)))
    operator.delete_site("local")
