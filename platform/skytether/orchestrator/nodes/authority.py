"""The authority of joined nodes: it signs their certificates, and those that the orchestrator shows to them.

It is not that of the API's certificate, which others sign and renew: a node trusts this one alone, so whatever becomes
of the API's is nothing to it. Its key is a file beside ``secret.key``, the same for all orchestrators of a database.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import ssl
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from skytether.api.node import ALPN, SERVER_NAME

from ..domain.errors import Fault, InvalidError
from ..domain.security import SecretFileError, secret_file

KEY = "nodes.key"
_DAY = 86_400.0
_BACKDATED_S = _DAY
"""Certificates are good from so long before, at most: a node's clock may be behind."""
_OURS_S = 90 * _DAY
"""For how long the orchestrator's are good."""
_OURS_RENEWED_S = 30 * _DAY
"""After which the orchestrator shows another one."""
_BEGIN, _END = datetime(2020, 1, 1, tzinfo=UTC), datetime(2120, 1, 1, tzinfo=UTC)
"""Of the authority. The orchestrator's certificates begin with it, too: a node without a clock of its own has the time
at which it was switched off, until it has asked for a better one."""
_NO_CHECK_TIME = 0x200000
"""OpenSSL's X509_V_FLAG_NO_CHECK_TIME. Whether a node's certificate is over is judged by the clock that all
orchestrators share; and one that is may ask for another for a while, which a handshake that fails would not let it."""


class Authority:
    """Signs. Safe from any thread."""

    def __init__(self, folder: Path, clock: Callable[[], float]) -> None:
        """Read the key, or make it.

        Args:
            folder: Of the orchestrator's secrets.
            clock: Seconds since the epoch.

        Raises:
            SecretFileError: It cannot be used.
        """
        self._clock = clock
        path = folder / KEY
        try:
            key = serialization.load_pem_private_key(secret_file(path, _new_key), None)
        except (ValueError, TypeError, UnsupportedAlgorithm) as error:
            raise SecretFileError(f"{path} holds no private key: put it back, all joined nodes know it") from error
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise SecretFileError(f"{path} holds another kind of key than was made there: put it back")
        self._key = key
        self.certificate = self._own()
        self.pem = pem_of(self.certificate)
        self.pin = pin_of(self.certificate)
        """SHA-256 of the public key, hexadecimal: in each join token, so that a node knows whom it talks to."""

    def _own(self) -> x509.Certificate:
        """Made anew at each start: by name and key it is always the same, and nodes need no more."""
        public = self._key.public_key()
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "Skytether nodes")])
        usage = x509.KeyUsage(
            digital_signature=False,
            content_commitment=False,
            key_encipherment=False,
            data_encipherment=False,
            key_agreement=False,
            key_cert_sign=True,
            crl_sign=False,
            encipher_only=False,
            decipher_only=False,
        )
        serial = int.from_bytes(hashlib.sha256(_spki(public)).digest()[:16], "big") | 1
        return (
            x509.CertificateBuilder(name, name, public, serial, _BEGIN, _END)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(usage, critical=True)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(public), critical=False)
            .sign(self._key, hashes.SHA256())
        )

    def sign(self, request: str, name: str, days: float) -> x509.Certificate:
        """A certificate for the key of a node's request; nothing else of the request is believed.

        Raises:
            InvalidError: It is no request, or whoever sent it has not the key.
        """
        # No longer before than after, or two thirds of it, when a node renews it, are over as it joins.
        begins = datetime.fromtimestamp(self._clock() - min(_BACKDATED_S, days * _DAY), UTC)
        return self._sign(requested_key(request), name, begins, days * _DAY, server=False)

    def _sign(
        self, public: ec.EllipticCurvePublicKey, name: str, begins: datetime, after_s: float, *, server: bool
    ) -> x509.Certificate:
        ends = datetime.fromtimestamp(self._clock() + after_s, UTC)
        usage = ExtendedKeyUsageOID.SERVER_AUTH if server else ExtendedKeyUsageOID.CLIENT_AUTH
        builder = (
            x509.CertificateBuilder()
            .issuer_name(self.certificate.subject)
            .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)]))
            .public_key(public)
            .serial_number(secrets.randbits(126) | 1 << 126)
            .not_valid_before(begins)
            .not_valid_after(ends)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(x509.ExtendedKeyUsage([usage]), critical=True)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(public), critical=False)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key()), critical=False)
        )
        if server:
            builder = builder.add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False)
        return builder.sign(self._key, hashes.SHA256())

    def server_context(self) -> ssl.SSLContext:
        """What the orchestrator shows to nodes, with a key that is in memory alone.

        Nodes need not show a certificate, for one that joins has none; but none by anybody else's authority is taken.
        """
        key = ec.generate_private_key(ec.SECP256R1())
        leaf = self._sign(key.public_key(), SERVER_NAME, _BEGIN, _OURS_S, server=True)
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_3
        context.set_alpn_protocols([ALPN])
        context.num_tickets = 0  # each connection shows its certificate itself
        context.verify_mode = ssl.CERT_OPTIONAL
        context.verify_flags |= ssl.VerifyFlags(_NO_CHECK_TIME)
        context.load_verify_locations(cadata=self.pem)
        file = os.memfd_create("nodes", os.MFD_CLOEXEC)  # the key is on no disk
        try:
            os.write(file, _private_pem(key) + (pem_of(leaf) + self.pem).encode())
            context.load_cert_chain(f"/proc/self/fd/{file}")
        finally:
            os.close(file)
        return context


class LiveContext:
    """The orchestrator's end of TLS with nodes, whose certificate is another one long before it ends."""

    def __init__(self, authority: Authority, clock: Callable[[], float]) -> None:
        """``clock`` gives seconds since the epoch."""
        self._authority = authority
        self._clock = clock
        self.authority = authority.pem
        """Of whom the certificate is."""
        self._made_at = clock()
        self._context = authority.server_context()

    @property
    def context(self) -> ssl.SSLContext:
        """For the next connection."""
        if not 0 <= self._clock() - self._made_at < _OURS_RENEWED_S:
            self._context, self._made_at = self._authority.server_context(), self._clock()
        return self._context


def requested_key(request: str) -> ec.EllipticCurvePublicKey:
    """The public key of a request for a certificate, whose sender has the private one.

    Raises:
        InvalidError: It is no such request.
    """
    try:
        read = x509.load_pem_x509_csr(request.encode())
        key = read.public_key()
        if not isinstance(key, ec.EllipticCurvePublicKey) or not isinstance(key.curve, ec.SECP256R1):
            raise InvalidError([Fault("request", "must be for a key on the curve P-256")])
        key.verify(read.signature, read.tbs_certrequest_bytes, ec.ECDSA(hashes.SHA256()))
    except (ValueError, InvalidSignature, UnsupportedAlgorithm) as error:
        raise InvalidError([Fault("request", "is no request for a certificate, signed with its own key")]) from error
    return key


def pin_of(certificate: x509.Certificate) -> str:
    """SHA-256 of a certificate's public key, hexadecimal."""
    return fingerprint(certificate.public_key())


def fingerprint(public: object) -> str:
    """SHA-256 of a public key, hexadecimal."""
    return hashlib.sha256(_spki(public)).hexdigest()


def serial_of(certificate: x509.Certificate) -> str:
    """As it is kept."""
    return f"{certificate.serial_number:x}"


def name_in(certificate: x509.Certificate) -> str:
    """Whose it is."""
    found = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(found[0].value) if found else ""


def _spki(public: object) -> bytes:
    return public.public_bytes(  # type: ignore[attr-defined, no-any-return]
        serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo
    )


def pem_of(certificate: x509.Certificate) -> str:
    """As it is sent, and kept in files."""
    return certificate.public_bytes(serialization.Encoding.PEM).decode()


def _private_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _new_key() -> bytes:
    return _private_pem(ec.generate_private_key(ec.SECP256R1()))
