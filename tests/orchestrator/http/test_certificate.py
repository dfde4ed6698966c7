"""Files of a certificate, as they are found and renewed on the disk."""

from __future__ import annotations

import os
import ssl
from pathlib import Path

import pytest
from certificates import certificate

from skytether.orchestrator.domain.security import SecretFileError
from skytether.orchestrator.http.certificate import LiveCertificate


def shown(live: LiveCertificate) -> bytes | None:
    """The certificate that a client is shown which takes any."""
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname, client.verify_mode = False, ssl.CERT_NONE
    ways = ssl.MemoryBIO(), ssl.MemoryBIO()
    ours, theirs = client.wrap_bio(*ways), live.context.wrap_bio(*reversed(ways), server_side=True)
    for end in (ours, theirs, ours):
        try:
            end.do_handshake()
        except ssl.SSLWantReadError:
            continue
    return ours.getpeercert(binary_form=True)


def in_file(path: Path) -> bytes:
    return ssl.PEM_cert_to_DER_cert(path.read_text())


def test_a_renewed_certificate_takes_the_place_of_one_of_another_kind_of_key(tmp_path: Path) -> None:
    """Clients prefer the first kind, and were shown it on, until it had expired and after."""
    cert, key = certificate(tmp_path)
    live = LiveCertificate(cert, key)
    assert shown(live) == in_file(cert)
    certificate(tmp_path, ed=True)
    live.reload()
    assert shown(live) == in_file(cert)


@pytest.mark.parametrize("mode", [0o604, 0o666, 0o602])
def test_a_key_that_others_can_read_is_refused(tmp_path: Path, mode: int) -> None:
    cert, key = certificate(tmp_path)
    key.chmod(mode)
    with pytest.raises(SecretFileError, match=f"others can read the key: chmod 600 {key}"):
        LiveCertificate(cert, key)
    key.chmod(0o640)  # a group of those that may, as Debian's ssl-cert
    live = LiveCertificate(cert, key)
    before = shown(live)
    certificate(tmp_path)
    key.chmod(mode)
    live.reload()
    assert shown(live) == before
    key.chmod(0o600)
    live.reload()
    assert shown(live) == in_file(cert)


def test_a_pipe_in_place_of_a_key_holds_up_nobody(tmp_path: Path) -> None:
    cert, key = certificate(tmp_path)
    live = LiveCertificate(cert, key)
    key.unlink()
    os.mkfifo(key, 0o600)
    live.reload()
    assert shown(live) == in_file(cert)
    with pytest.raises(SecretFileError, match="is no file"):
        LiveCertificate(cert, key)
