"""Whether what we show an API server has expired."""

from __future__ import annotations

import base64
import json
from datetime import UTC, datetime
from pathlib import Path

from cryptography import x509


def expired(certificate: str | None, token: str | None, now: float) -> str:
    """What of it has, and when; empty: nothing that can be read.

    Args:
        certificate: File with the client's certificate.
        token: As it is sent; those of service accounts say until when they are good.
        now: Seconds since the epoch.
    """
    for what, until in (("certificate", _of_certificate(certificate)), ("token", _of_token(token))):
        if until is not None and until <= now:
            return f"the {what} expired at {datetime.fromtimestamp(until, UTC):%Y-%m-%d %H:%M:%S} UTC"
    return ""


def _of_certificate(path: str | None) -> float | None:
    try:
        read = x509.load_pem_x509_certificate(Path(path).read_bytes()) if path else None
    except (OSError, ValueError):
        return None
    return read.not_valid_after_utc.timestamp() if read is not None else None


def _of_token(token: str | None) -> float | None:
    """Of a JSON Web Token (RFC 7519)."""
    try:
        payload = (token or "").split(".")[1]
        until = json.loads(base64.urlsafe_b64decode(payload + "=" * (-len(payload) % 4)))["exp"]
    except (IndexError, ValueError, KeyError, TypeError):
        return None
    return float(until) if isinstance(until, int | float) else None
