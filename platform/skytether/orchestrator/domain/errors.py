"""What can be wrong with a request, in terms of the domain; ``problems`` turns it into HTTP.

Each text is one sentence for the person who asked, with what to do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from skytether.api.validation_errors import Fault as Fault


class DomainError(Exception):
    """Base: a request that cannot be served."""


class NotFoundError(DomainError):
    """There is no such thing; the text names what there is."""


class ConflictError(DomainError):
    """It is there, but not in a state in which this can be done."""


class NoSiteError(ConflictError):
    """No site could ever run this; the text holds each site's number."""

    def __init__(self, text: str, refused: Sequence[dict[str, Any]]) -> None:
        super().__init__(text)
        self.refused = tuple(refused)


class QuotaError(ConflictError):
    """It would be more than somebody may have."""


class ForbiddenError(DomainError):
    """The token is good, but not for this."""


class UnauthenticatedError(DomainError):
    """No token, or one that is not good."""


class UnknownTokenError(UnauthenticatedError):
    """A token that nobody was given, or that was revoked."""


class SilentSiteError(DomainError):
    """What was asked for is at a site that does not answer now."""


class OutdatedError(DomainError):
    """Another orchestrator, of a newer version, has the database now."""

    def __init__(self) -> None:
        super().__init__(
            "a newer orchestrator has brought the database to its schema: ask that one, and end or update this one"
        )


class TooManyError(DomainError):
    """More requests than one caller may make."""

    def __init__(self, wait_s: float, text: str = "", who: str = "") -> None:
        """``wait_s``: until the next may be made; ``text`` instead of that they come too often; ``who``: it was."""
        self.who = who
        self.retry_after = max(1, math.ceil(wait_s))
        super().__init__(text or f"too many requests: try again in {self.retry_after} s, and ask less often")


class InvalidError(DomainError):
    """A document with wrong keys."""

    def __init__(self, faults: Sequence[Fault], what: str = "") -> None:
        """``what`` names the document where the reader could not know: a file, a service's parameters."""
        self.faults = tuple(faults)
        super().__init__((f"{what}: " if what else "") + "; ".join(str(f) for f in self.faults))
