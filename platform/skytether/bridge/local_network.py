"""One of a robot's networks, as a configuration names it."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from skytether.api.config_file import Endpoint
from skytether.api.manifest import Strict


class LocalNetwork(Strict):
    """One of the robot's networks."""

    local: Annotated[str, Field(min_length=1)]
    """The interface's name (``wlan0``) or one of this machine's addresses."""
    cost: Annotated[int, Field(ge=0, le=255)] = 0
    """Of networks that work as well as each other the cheapest is used."""
    peer: Endpoint | None = None
    """Where the service's end is as seen from this network; null: as from all."""
