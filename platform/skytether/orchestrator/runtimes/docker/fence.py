"""Which leader acts at an engine: told by a volume that holds nothing, named after the leader's epoch.

An engine has no lock, so an act cannot be kept from being overtaken between its look and its call. What makes that
harmless: a container is made first, under a name that only one can have; then it is looked whether another one leads;
only then it is begun. Whatever a later leader finds made and not begun it removes. And what is to be ended is chosen
before it is looked whether another one leads: so nothing is ended that a later leader has begun. A container whose
begin got no answer is left as it is where another one leads by now, who may have adopted it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from docker.errors import APIError

from ..base import OvertakenError
from .engine import Engine
from .objects import EPOCH, OWNER, epoch_volume


class Fence:
    """That of one site. From any thread."""

    def __init__(self, engine: Engine, owner: str) -> None:
        self._engine = engine
        self._owner = owner
        self.epoch = 0
        """Of the leader who acts here; 0: whoever it is."""

    def lead(self, epoch: int) -> None:
        """From now on act for the leader of this epoch, and let nobody act for an earlier one; may be called again.

        Raises:
            OvertakenError: A leader of a later epoch was here.
            RuntimeFailure: The engine does not answer.
        """
        there = self._there()
        self._must_be_latest(epoch, there)
        self.epoch = epoch
        if epoch not in there:
            name, labels = epoch_volume(self._owner, epoch)
            with self._engine.asked():
                self._engine.api().create_volume(name, labels=labels)
        self._remove(name for found, name in there.items() if found < epoch)

    def must_lead(self, epoch: int | None = None) -> None:
        """See whether another leader was here.

        Args:
            epoch: Of the leader on whose behalf something is done; None: that of now.

        Raises:
            OvertakenError: One of a later epoch.
            RuntimeFailure: The engine does not answer.
        """
        epoch = self.epoch if epoch is None else epoch
        if epoch:
            self._must_be_latest(epoch, self._there())

    def _must_be_latest(self, epoch: int, there: Mapping[int, str]) -> None:
        latest = max(there, default=0)
        if latest > epoch:
            raise OvertakenError.by_leader(f"the volume {there[latest]}", latest)

    def clear(self) -> None:
        """Leave nothing: the site is no more."""
        self._remove(self._there().values())

    def _there(self) -> dict[int, str]:
        """Volumes of epochs; more than one for a moment."""
        with self._engine.asked():
            said: dict[str, Any] = self._engine.api().volumes({"label": [f"{OWNER}={self._owner}", EPOCH]})
        volumes = {str(v["Name"]): str((v.get("Labels") or {}).get(EPOCH, "")) for v in said["Volumes"] or ()}
        return {int(epoch): name for name, epoch in volumes.items() if re.fullmatch("[0-9]{1,18}", epoch)}

    def _remove(self, names: Any) -> None:
        with self._engine.asked():
            for name in names:
                remove_volume(self._engine, name)


def remove_volume(engine: Engine, name: str) -> None:
    """Remove a volume that nobody uses; one that is gone, or in use by now, stays so.

    Raises:
        APIError: The engine refuses.
    """
    try:
        engine.api().remove_volume(name)
    except APIError as error:
        if error.status_code not in (404, 409):
            raise
