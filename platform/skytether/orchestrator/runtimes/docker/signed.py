"""Which images an operator vouches for: signatures (Ed25519, RFC 8032) of an image's id, checked before each start.

The id is a SHA-256, and another after any change: of the image's configuration, which names all of its layers by
theirs, or, where the engine keeps images in containerd's store (new installations of Docker 29), of its manifest or
index, which names both. So the same image has one id at engines of the one kind, and another at those of the other. A
signature is a file ``HEX.sig`` of 64 bytes, HEX being the id's digits.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable
from pathlib import Path

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from ..base import RuntimeFailure


def message(image_id: str) -> bytes:
    """What is signed: of an image, and of nothing else that the same key may sign."""
    return f"skytether image {image_id}\n".encode()


def signature_file(folder: str, image_id: str) -> Path:
    """Where the signature of an image is looked for."""
    return Path(folder) / f"{image_id.removeprefix('sha256:')}.sig"


def check(image: str, image_id: str, signers: Iterable[str], folder: str) -> None:
    """See that one of the signers has signed an image.

    Args:
        image: Its name, for the message.
        image_id: ``sha256:HEX``.
        signers: Public keys, 32 bytes in base64.
        folder: With the signatures.

    Raises:
        RuntimeFailure: Nobody of them has.
    """
    file = signature_file(folder, image_id)
    try:
        signature = file.read_bytes()
    except OSError as error:
        raise RuntimeFailure(f"image '{image}' is not signed: {file}: {error.strerror}") from error
    for signer in signers:
        try:
            Ed25519PublicKey.from_public_bytes(base64.b64decode(signer)).verify(signature, message(image_id))
        except InvalidSignature:
            continue
        return
    raise RuntimeFailure(f"image '{image}' is signed by none of the site's signers ({file})")
