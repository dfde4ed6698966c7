"""Calls to an orchestrator: one request, one answer, over TLS with the one authority that a node trusts."""

from __future__ import annotations

import contextlib
import hashlib
import socket
import ssl
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from pydantic import ValidationError

from skytether.api.manifest import Strict
from skytether.api.node import ALPN, ANSWER_S, MOST_LINE, SERVER_NAME, Hello, Refused, Welcome, line_of, read_url
from skytether.api.printable import printable

from .store import NodeError

Answer = TypeVar("Answer", bound=Strict)


class UnreachableError(NodeError):
    """Nobody answers there; another orchestrator may, or this one later."""


class RefusedError(NodeError):
    """The orchestrator said no; its own sentence."""

    def __init__(self, refused: Refused) -> None:
        super().__init__(printable(refused.error, lines=False))
        self.final = refused.final
        self.over = refused.over


@dataclass(frozen=True)
class FirstAnswer:
    """Who answered a first call."""

    authority: str
    """PEM of the authority, as the token has it."""
    ahead_s: float
    """By how much the orchestrator's clock is before this machine's [s]; negative: behind."""


def trusting(authority: str, identity: Path | None = None) -> ssl.SSLContext:
    """Our end of TLS: believes one authority, and shows a certificate if there is one.

    Raises:
        NodeError: What is kept is damaged.
    """
    context = _context()
    try:
        context.load_verify_locations(cadata=authority)
        if identity is not None:
            context.load_cert_chain(identity)
    except (OSError, ssl.SSLError) as error:
        raise NodeError(f"certificates in {identity} cannot be used ({error}): join again") from error
    return context


def _context() -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.set_alpn_protocols([ALPN])
    return context


def first_call(url: str, pin: str) -> FirstAnswer:
    """Find out who answers, before anything secret is said: only whose key the token names is believed.

    Raises:
        NodeError: Nobody answers, or somebody else.
    """
    context = _context()
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE  # nothing is believed yet: the authority that it shows is compared with the pin
    welcome = _call(url, context, Hello(), Welcome)
    try:
        authority = x509.load_pem_x509_certificate(welcome.authority.encode())
        spki = authority.public_key().public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    except ValueError:
        spki = b""
    if hashlib.sha256(spki).hexdigest() != pin:
        raise NodeError(
            f"whoever answers at {url} is not the orchestrator that made this token: its key is another one; somebody "
            "may be in between, or the address is another orchestrator's"
        )
    # This one certificate, and not the text: others may stand behind it there, which the pin says nothing of.
    return FirstAnswer(authority.public_bytes(Encoding.PEM).decode(), welcome.time - time.time())


def call(url: str, context: ssl.SSLContext, request: Strict, answer: type[Answer]) -> Answer:
    """Ask.

    Raises:
        UnreachableError: Nobody answers there.
        RefusedError: It was refused.
        NodeError: Somebody else answers.
    """
    return _call(url, context, request, answer)


def _call(url: str, context: ssl.SSLContext, request: Strict, answer: type[Answer]) -> Answer:
    host, port = address_of(url)
    try:
        with (
            socket.create_connection((host, port), timeout=ANSWER_S) as plain,
            context.wrap_socket(plain, server_hostname=SERVER_NAME) as link,
        ):
            _check_protocol(link.selected_alpn_protocol(), url)
            until = time.monotonic() + 6 * ANSWER_S  # a site that ends may take its time
            link.sendall(line_of(request))
            line = b""
            while not line.endswith(b"\n"):
                link.settimeout(max(0.01, until - time.monotonic()))  # in drops it takes no longer
                piece = link.recv(MOST_LINE)
                line += piece
                if not piece or len(line) > MOST_LINE:
                    raise UnreachableError(f"{url} ended the connection without an answer: try again in a moment")
    except OSError as error:
        raise explained(url, error) from error
    return read_answer(line, answer, url)


def read_answer(line: bytes, answer: type[Answer], url: str) -> Answer:
    """What a line says.

    Raises:
        RefusedError: No.
        NodeError: Nothing that is understood.
    """
    with contextlib.suppress(ValidationError):
        raise RefusedError(Refused.model_validate_json(line))
    try:
        return answer.model_validate_json(line)
    except ValidationError:
        raise NodeError(f"the answer of {url} is not understood: has the orchestrator another version?") from None


def _check_protocol(spoken: str | None, url: str) -> None:
    if spoken != ALPN:
        raise NodeError(
            f"{url} is not where nodes connect: it speaks something else, the API perhaps; the port is the "
            "orchestrator's nodes.port (8603 unless it says otherwise)"
        )


def address_of(url: str) -> tuple[str, int]:
    """Host and port.

    Raises:
        NodeError: It is no address.
    """
    try:
        return read_url(url)
    except ValueError as error:
        raise NodeError(str(error)) from None


def explained(url: str, error: OSError) -> NodeError:
    """What a failed connection means, and the check that shows it."""
    host, port = address_of(url)
    text = str(error)
    if isinstance(error, ssl.SSLCertVerificationError):
        why = error.verify_message
        if "not yet valid" in why or "expired" in why:
            return UnreachableError(
                f"the certificate of {url} is {'not good yet' if 'yet' in why else 'over'} by this machine's clock "
                f"({datetime.now(UTC):%Y-%m-%d %H:%M} UTC): set that right (timedatectl set-ntp true)"
            )
        return NodeError(
            f"whoever answers at {url} is not the orchestrator that this machine joined ({why}): somebody may be in "
            "between; nothing was said to them"
        )
    if isinstance(error, ssl.SSLError) and "ALPN" in text.upper().replace("NO_APPLICATION_PROTOCOL", "ALPN"):
        return NodeError(
            f"{url} is not where nodes connect: the port is the orchestrator's nodes.port (8603 as a rule)"
        )
    if isinstance(error, ssl.SSLError) and ("WRONG_VERSION" in text or "UNEXPECTED_EOF" in text or "EOF" in text):
        return UnreachableError(f"{url} speaks no TLS for nodes: is the port the orchestrator's nodes.port (8603)?")
    if isinstance(error, socket.gaierror):
        return UnreachableError(f"the name '{host}' has no address here: `getent hosts {host}` shows what is known")
    why = "nobody listens there" if isinstance(error, ConnectionRefusedError) else error.strerror or "no answer in time"
    return UnreachableError(
        f"TCP port {port} of {host} cannot be reached ({why}): is nodes.port set at the orchestrator, with nodes.host "
        "an address that is reached from here, and does every firewall in between let it through? "
        f"`nc -vz {host} {port}` shows it"
    )
