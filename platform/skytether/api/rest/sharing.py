"""What services of several robots of a group share."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import AfterValidator, Field

from skytether.api.manifest import Strict

MOST_SHARED = 8192
"""Bytes of UTF-8 that a service may share at a time; with them a robot's request counts as one or two."""
_UNSHARED = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff]")
"""Six times as long in JSON. Without them what 15 robots say is at most twice 15 times `MOST_SHARED` there."""
MOST_NEIGHBOURS = 15
"""Robots of a group whose words one of them gets: those heard last."""


def unshareable(text: str) -> str | None:
    """Why a text cannot be shared between robots; None: it can."""
    if (size := len(text.encode(errors="surrogatepass"))) > MOST_SHARED:
        return f"it has {size} bytes, and {MOST_SHARED} at most are carried"
    if _UNSHARED.search(text):
        return "it has control characters, of which only tabs and ends of lines are carried"
    return None


def _shareable(text: str) -> str:
    if why := unshareable(text):
        raise ValueError(why)
    return text


class Share(Strict):
    """What an instance's service shares, and what it hears for it."""

    text: Annotated[str, Field(max_length=MOST_SHARED), AfterValidator(_shareable)] | None = None
    """Instead of what it said before; None: nothing new."""
    age_s: Annotated[float, Field(ge=0, le=3600)] = 0.0
    """How long ago the robot got it of its service."""


class Shared(Strict):
    """What the same service of another robot of the group said last."""

    robot: str
    age_s: float
    """How long ago it did, but for the way to its robot and from there."""
    text: str


class Neighbours(Strict):
    """What a robot's neighbours share with it."""

    group: str | None = None
    """The robot's; None: it is in none, and nothing is kept of what it said."""
    others: tuple[Shared, ...] = ()
