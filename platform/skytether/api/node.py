"""What a joined node and its orchestrator say to each other: lines of JSON over TLS, one request a connection.

A node opens every connection; the orchestrator opens none. After the handshake it sends one request. What becomes of
the connection depends on that: an answer and its end, the node's link, which stays, or a way to the node's engine.
"""

from __future__ import annotations

import contextlib
import re
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from .manifest import Name, Strict, Tier

PORT = 8603
"""TCP, where nodes connect unless an address says otherwise."""
ALPN = "skytether-node/1"
SERVER_NAME = "orchestrator.skytether.internal"
"""In the certificate that an orchestrator shows to nodes, wherever it is: its authority signs no other with it."""
MOST_LINE = 32_768
"""Bytes of a line: a request for a certificate has one, with what is known of the machine."""
ANSWER_S = 10.0
"""Seconds for a handshake, for a request, and for an answer."""
PING_S, SILENT_S = 5.0, 15.0
"""Between two signs of life on a link, and after which it is dead [s]."""
GO = b"\1"
"""The orchestrator's word, once, before the bytes of somebody who asks the engine."""
MOST_WAYS = 1024
"""Ways to its engine that a node has open at most: each container of it takes one, and 32 are kept."""
_PEM = Annotated[str, Field(max_length=16_384)]
Address = Annotated[str, Field(min_length=1, max_length=253, pattern=r"^[A-Za-z0-9._:-]+$")]
"""An address or a name, without a port."""
_ODD = re.compile(r"[\s\x00-\x1f\x7f]")
Port = Annotated[int, Field(ge=1, le=65_535)]


class Heard(Strict):
    """Base of all of it. What a later version says beyond is left out: orchestrators and nodes are updated in turn."""

    model_config = ConfigDict(extra="ignore")


class Machine(Heard):
    """What a node says of itself."""

    id: Annotated[str, Field(max_length=64)] = ""
    """The same as long as it is the same machine: a hash of /etc/machine-id."""
    hostname: Annotated[str, Field(max_length=253)] = ""
    system: Annotated[str, Field(max_length=120)] = ""
    architecture: Annotated[str, Field(max_length=32)] = ""
    """As container images name it, ``amd64`` or ``arm64``."""
    cpu: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    """Cores."""
    memory_mb: Annotated[int, Field(ge=0, le=1 << 40)] = 0
    disk_mb: Annotated[int, Field(ge=0, le=1 << 50)] = 0
    """Free, where the engine keeps what it has."""
    engine: Annotated[str, Field(max_length=120)] = ""
    """Its version."""
    version: Annotated[str, Field(max_length=64)] = ""
    """Of Skytether there."""
    echo: Port | None = None
    """UDP port of the echo for robots' probes; None: it has none."""


class Hello(Heard):
    """Who are you? Asked before anything is believed; the answer is checked by what the join token says."""

    do: Literal["hello"] = "hello"


class Look(Heard):
    """Is this join token good?"""

    do: Literal["look"] = "look"
    token: Annotated[str, Field(max_length=256, repr=False)]


class Join(Heard):
    """Make this machine a site."""

    do: Literal["join"] = "join"
    token: Annotated[str, Field(max_length=256, repr=False)]
    request: _PEM
    """For a certificate (PKCS #10)."""
    address: Address
    """That robots are told."""
    follow: bool = False
    """Whether the address follows the machine's: nobody named it."""
    ports: tuple[Port, Port] | None = None
    """UDP, for sessions; None: those that the engine chooses."""
    machine: Machine = Machine()


class Renew(Heard):
    """Another certificate, by the one of this connection."""

    do: Literal["renew"] = "renew"
    request: _PEM


class Link(Heard):
    """This connection stays: here the orchestrator says what it needs."""

    do: Literal["link"] = "link"
    machine: Machine = Machine()
    address: Address | None = None
    """That robots are told from now on; None: as before."""


class Way(Heard):
    """This connection is for somebody who asks the engine: after `GO` come the bytes of both."""

    do: Literal["way"] = "way"
    link: Annotated[str, Field(max_length=64, repr=False)] = ""
    """Of which link it is: its `Linked.link`."""


class Standing(Heard):
    """How does the site look from there?"""

    do: Literal["standing"] = "standing"


class Leave(Heard):
    """This machine is to be no site any more."""

    do: Literal["leave"] = "leave"
    force: bool = False
    """At once, whatever runs here; otherwise what can be moved is moved first."""


class Welcome(Heard):
    """Answer to `Hello`."""

    time: float
    """Seconds since the epoch."""
    authority: _PEM


class Invited(Heard):
    """Answer to `Look`."""

    name: Name
    tier: Tier
    ends_at: float
    urls: tuple[str, ...] = ()


class Issued(Heard):
    """Answer to `Join` and `Renew`."""

    name: Name
    certificate: _PEM
    urls: tuple[str, ...] = ()
    """Of all orchestrators, as far as this one was told."""


class Stands(Heard):
    """Answer to `Standing` and `Leave`."""

    state: Literal["ready", "unreachable", "blocked", "gone"]
    reason: str = ""
    instances: int = 0
    draining: bool = False
    """It takes no more instances."""
    echo: bool | None = None
    """Whether the node's echo answered the orchestrator; None: it was not asked."""
    seen_as: str = ""
    """The address that the node's connections come from."""
    cpu: float | None = None
    memory_mb: int | None = None


class Linked(Heard):
    """Answer to `Link`, before anything else comes there."""

    time: float
    begins: float
    ends: float
    """Validity of the certificate that the orchestrator knows of this node."""
    link: Annotated[str, Field(max_length=64, repr=False)] = ""
    """Known at the two ends of this link alone: a copy of the node's key elsewhere opens none of its ways."""
    urls: tuple[str, ...] = ()


class Told(Heard):
    """A line that the orchestrator sends on a link."""

    ping: int | None = None
    open: Annotated[int, Field(ge=1, le=MOST_WAYS)] | None = None
    """So many more ways are wanted."""


class Said(Heard):
    """A line that a node sends on its link."""

    pong: int | None = None
    engine: Annotated[str, Field(max_length=300)] | None = None
    """Why its engine cannot be reached; empty: it can."""
    failed: Annotated[int, Field(ge=1, le=MOST_WAYS)] | None = None
    """So many of the ways that were wanted could not be opened."""


class Refused(Heard):
    """Instead of any answer."""

    error: Annotated[str, Field(max_length=2000)]
    """One sentence with what to do."""
    final: bool = True
    """Whether asking again later would be refused too."""
    over: bool = False
    """The certificate that was shown is over, and may be renewed."""


Request = Annotated[
    Hello | Look | Join | Renew | Link | Way | Standing | Leave,
    Field(discriminator="do"),
]
_REQUEST: TypeAdapter[Request] = TypeAdapter(Request)


def read_url(text: str) -> tuple[str, int]:
    """Host and port of where nodes connect.

    Raises:
        ValueError: It is no ``https://HOST[:PORT]``.
    """
    with contextlib.suppress(ValueError):
        parts = urlsplit(text.strip())
        plain = not (parts.path.strip("/") or parts.query or parts.fragment or parts.username)
        if parts.scheme == "https" and parts.hostname and plain and not _ODD.search(parts.hostname):
            parts.hostname.encode("idna")  # what has no such form is looked up nowhere, and raises wherever it is tried
            return parts.hostname, parts.port or PORT
    raise ValueError(f"'{text}' is not where nodes connect: write https://HOST or https://HOST:PORT")


def read_request(line: bytes) -> Request:
    """What a line asks for.

    Raises:
        ValueError: Nothing that we know; with a sentence.
    """
    try:
        return _REQUEST.validate_json(line)
    except (ValidationError, RecursionError) as error:
        raise ValueError(f"this is no request that an orchestrator of this version knows ({_first(error)})") from None


def line_of(message: Strict) -> bytes:
    """A message as a line."""
    return message.model_dump_json(exclude_none=True).encode() + b"\n"


def _first(error: Exception) -> str:
    if isinstance(error, ValidationError):
        first: Any = error.errors(include_url=False, include_input=False, include_context=False)[0]
        return f"{'.'.join(str(part) for part in first['loc'])}: {first['msg']}"[:200]
    return "it is too deep"
