"""Whether a node can be known by a certificate: proved by a handshake in memory, before it has no other any more."""

from __future__ import annotations

import contextlib
import os
import ssl
from datetime import UTC, datetime, timedelta

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from skytether.api.node import SERVER_NAME
from skytether.api.printable import printable

_ROUNDS = 4
"""In which either end says what it has to; a handshake takes two."""
_MOST = 200
"""Characters of a library's words."""
_NO_CHECK_TIME = 0x200000
"""OpenSSL's X509_V_FLAG_NO_CHECK_TIME, as orchestrators have it: a node's own clock may be wrong."""


def unfit(certificate: str, key: ec.EllipticCurvePrivateKey, name: str, authority: str, until: float) -> str | None:
    """Why a node cannot be known by a certificate; None: it can.

    Whoever has the authority's key signs any: by an algorithm that no program takes, for servers, for somebody else.

    Args:
        certificate: The PEM of it.
        key: Whose it is to be.
        name: The node's.
        authority: The PEM of whom the node trusts.
        until: It is to be good after that, by the orchestrator's clock [s].
    """
    try:
        made = x509.load_pem_x509_certificate(certificate.encode())
        made.verify_directly_issued_by(x509.load_pem_x509_certificate(authority.encode()))
        if made.public_key() != key.public_key():
            return "it is for another key"
        if [one.value for one in made.subject.get_attributes_for_oid(NameOID.COMMON_NAME)] != [name]:
            return "it is for another name"
        if not max(until, made.not_valid_before_utc.timestamp()) < made.not_valid_after_utc.timestamp():
            return "it is over already"
        _shake_hands(_loaded(ssl.PROTOCOL_TLS_CLIENT, key, made), _door(authority))
    except Exception as error:  # whatever a library finds wrong with it
        return printable(str(error), lines=False)[:_MOST] or type(error).__name__
    return None


def identity(key: ec.EllipticCurvePrivateKey, certificate: x509.Certificate) -> bytes:
    """Key and certificate, as they are in a file."""
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return private + certificate.public_bytes(serialization.Encoding.PEM)


def _loaded(protocol: int, key: ec.EllipticCurvePrivateKey, certificate: x509.Certificate) -> ssl.SSLContext:
    context = ssl.SSLContext(protocol)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE  # what is proved is what the node shows: at its other end we are ourselves
    file = os.memfd_create("identity", os.MFD_CLOEXEC)
    try:
        os.write(file, identity(key, certificate))
        context.load_cert_chain(f"/proc/self/fd/{file}")
    finally:
        os.close(file)
    return context


def _door(authority: str) -> ssl.SSLContext:
    """As an orchestrator has it towards nodes, but for a certificate of its own, and that it wants one."""
    key, name = (
        ec.generate_private_key(ec.SECP256R1()),
        x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, SERVER_NAME)]),
    )
    now, day = datetime.now(UTC), timedelta(days=1)
    shown = x509.CertificateBuilder(name, name, key.public_key(), 1, now - day, now + day).sign(key, hashes.SHA256())
    context = _loaded(ssl.PROTOCOL_TLS_SERVER, key, shown)
    context.verify_mode = ssl.CERT_REQUIRED
    context.verify_flags |= ssl.VerifyFlags(_NO_CHECK_TIME)
    context.load_verify_locations(cadata=authority)
    return context


def _shake_hands(node: ssl.SSLContext, door: ssl.SSLContext) -> None:
    """Raises ``ssl.SSLError`` where one of them does not take the other."""
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = node.wrap_bio(back, there), door.wrap_bio(there, back, server_side=True)
    for _ in range(_ROUNDS):
        for end in ends:
            with contextlib.suppress(ssl.SSLWantReadError):
                end.do_handshake()
    for end in ends:
        end.do_handshake()  # which has nothing to do any more
