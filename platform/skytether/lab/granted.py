"""A client of an orchestrator that there is not, for an agent whose session is there already."""

from __future__ import annotations

from datetime import UTC, datetime

from skytether.api import rest


class Granted:
    """An orchestrator that gives the one session there is."""

    def __init__(self, session: rest.Session) -> None:
        now = datetime.now(UTC)
        self._instance = rest.Instance(
            id="bench",
            robot="bench",
            service="bench",
            state=rest.State.RUNNING,
            session=session,
            created_at=now,
            updated_at=now,
            lease_expires_at=now,
        )

    def create_instance(self, *_: object, **__: object) -> rest.Instance:
        return self._instance

    def get_instance(self, *_: object) -> rest.Instance:
        return self._instance

    def renew_instance(self, *_: object) -> rest.Instance:
        return self._instance

    def claim_session(self, *_: object) -> str:
        raise AssertionError("the session has its key")

    def delete_instance(self, *_: object) -> object:
        return self._instance
