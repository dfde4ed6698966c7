"""Images that somebody must have signed."""

from __future__ import annotations

import base64
import shutil
import subprocess
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from pydantic import ValidationError

from skytether.orchestrator.runtimes.base import RuntimeFailure
from skytether.orchestrator.runtimes.docker.images import ensure_image
from skytether.orchestrator.runtimes.docker.options import DockerOptions
from skytether.orchestrator.runtimes.docker.signed import check, message, signature_file

ID, OTHER = "sha256:" + "ab" * 32, "sha256:" + "cd" * 32


def public(key: Ed25519PrivateKey) -> str:
    return base64.b64encode(key.public_key().public_bytes_raw()).decode()


def sign(key: Ed25519PrivateKey, folder: str, image_id: str) -> Path:
    file = signature_file(folder, image_id)
    file.write_bytes(key.sign(message(image_id)))
    return file


class EngineWith:
    """Has one image."""

    def __init__(self, image_id: str) -> None:
        self.asked = nullcontext
        self._id = image_id

    def api(self) -> Any:
        return self

    def inspect_image(self, _: str) -> dict[str, str]:
        return {"Id": self._id}


def test_only_what_a_signer_signed_is_taken(tmp_path: Path) -> None:
    key, stranger = Ed25519PrivateKey.generate(), Ed25519PrivateKey.generate()
    options = DockerOptions(signers=(public(Ed25519PrivateKey.generate()), public(key)), signatures=str(tmp_path))
    one: Any = EngineWith(ID)
    with pytest.raises(RuntimeFailure, match=r"image 'toy:1' is not signed: .*No such file"):
        ensure_image(one, options, "toy:1", print)
    sign(stranger, str(tmp_path), ID)
    with pytest.raises(RuntimeFailure, match="signed by none of the site's signers"):
        ensure_image(one, options, "toy:1", print)
    file = sign(key, str(tmp_path), ID)
    assert ensure_image(one, options, "toy:1", print) == ID
    shutil.copy(file, signature_file(str(tmp_path), OTHER))  # a signature of another image
    changed: Any = EngineWith(OTHER)
    for by_digest in (False, True):  # the guard's, too
        with pytest.raises(RuntimeFailure, match="signed by none"):
            ensure_image(changed, options, "toy:1", print, by_digest=by_digest)
    file.write_bytes(b"")
    with pytest.raises(RuntimeFailure, match="signed by none"):
        ensure_image(one, options, "toy:1", print)
    assert ensure_image(changed, DockerOptions(), "toy:1", print) == OTHER


def test_keys_and_folder_go_together() -> None:
    key = public(Ed25519PrivateKey.generate())
    for wrong in ({"signers": [key]}, {"signatures": "/x"}, {"signers": ["short"], "signatures": "/x"}):
        with pytest.raises(ValidationError):
            DockerOptions.model_validate(wrong)


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is missing")
def test_what_the_page_says_openssl_does_is_a_signature(tmp_path: Path) -> None:
    def openssl(*arguments: str) -> bytes:
        return subprocess.run(["openssl", *arguments], cwd=tmp_path, check=True, capture_output=True).stdout

    openssl("genpkey", "-algorithm", "ed25519", "-out", "signer.pem")
    key = base64.b64encode(openssl("pkey", "-in", "signer.pem", "-pubout", "-outform", "DER")[-32:]).decode()
    (tmp_path / "message").write_bytes(message(ID))
    out = signature_file(str(tmp_path), ID).name
    openssl("pkeyutl", "-sign", "-inkey", "signer.pem", "-rawin", "-in", "message", "-out", out)
    check("toy:1", ID, [key], str(tmp_path))
