"""What a node keeps: whom it trusts, who it is, where it calls. A folder of root's, mode 0700."""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from pydantic import Field, TypeAdapter, ValidationError

from skytether.api.manifest import Device, Name, Strict
from skytether.api.node import Address, Port
from skytether.guard.folder import objection

from .proof import identity, unfit

DEFAULT_FOLDER = Path("/etc/skytether/node")
_CONFIG, _AUTHORITY, _IDENTITY, _NAMES = "node.json", "authority.pem", "identity.pem", "images.json"


class NodeError(Exception):
    """Something is wrong with the node or its way; one sentence with what to do."""


class NodeConfig(Strict):
    """How a node was joined."""

    name: Name
    urls: Annotated[tuple[str, ...], Field(min_length=1)]
    """Where it calls: all orchestrators that it knows."""
    engine: str
    """Path of its engine's socket."""
    address: Address
    """That robots are told."""
    follow: bool = False
    """Whether that is the machine's present address, for nobody named one."""
    echo: Port | None = None
    """UDP port of the echo; None: it has none."""
    devices: tuple[Device, ...] = ()
    """Files of devices that containers may have."""
    registries: tuple[str, ...] = ()
    """From which alone images are pulled; none: from any that is not this machine itself."""
    unfiltered: bool = False
    """Whether an orchestrator may ask the engine for anything, and so has all of this machine."""
    unit: bool = True
    """Whether a unit of systemd runs it."""


class NodeStore:
    """The folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @property
    def identity(self) -> Path:
        """Key and certificate, one file: never is there one without the other."""
        return self.folder / _IDENTITY

    def exists(self) -> bool:
        """Whether this machine is joined."""
        return (self.folder / _CONFIG).exists()

    def config(self) -> NodeConfig:
        """How it was joined.

        Raises:
            NodeError: It was not, the file is damaged, or somebody else could have put it there.
        """
        path = self.folder / _CONFIG
        if self.folder.is_dir() and (why := objection(str(self.folder))):
            raise NodeError(f"what is in {self.folder} is not trusted: {why}")
        try:
            return NodeConfig.model_validate_json(path.read_bytes())
        except FileNotFoundError:
            raise NodeError(
                f"this machine has not joined, as far as {self.folder} says: `skytether site join` makes it a site"
            ) from None
        except OSError as error:
            raise NodeError(f"cannot read {path}: {error.strerror}; run this as root, or give --folder") from error
        except ValidationError as error:
            raise NodeError(
                f"{path} is damaged ({error.errors()[0]['msg']}): run `skytether site leave --force`, and join again"
            ) from error

    def authority(self) -> str:
        """PEM of whom it trusts.

        Raises:
            NodeError: It is not there.
        """
        try:
            return (self.folder / _AUTHORITY).read_text()
        except OSError as error:
            raise NodeError(f"cannot read {self.folder / _AUTHORITY}: {error.strerror}; join again") from error

    def certificate(self) -> x509.Certificate:
        """Its own.

        Raises:
            NodeError: It is not there, or damaged.
        """
        try:
            return x509.load_pem_x509_certificate(self.identity.read_bytes())
        except (OSError, ValueError) as error:
            why = getattr(error, "strerror", None) or "it is damaged"
            raise NodeError(f"cannot read {self.identity}: {why}; join again") from error

    def save(self, config: NodeConfig) -> None:
        self._put(_CONFIG, config.model_dump_json(indent=1).encode() + b"\n")

    def join(self, config: NodeConfig, authority: str, key: ec.EllipticCurvePrivateKey, certificate: str) -> None:
        """Keep all of it, what says that it is joined last.

        Raises:
            NodeError: Nobody can be known by that certificate.
            OSError: It cannot be written.
        """
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.folder.chmod(0o700)
        self._put(_AUTHORITY, authority.encode())
        self._identify(key, certificate, config.name, 0.0)
        self.save(config)

    def renew(self, key: ec.EllipticCurvePrivateKey, certificate: str) -> None:
        """Be known by another key and certificate.

        Raises:
            NodeError: This machine cannot be known by it where it is to be: what is there stays.
            OSError: It cannot be written.
        """
        before = self.certificate()
        begins, ends = before.not_valid_before_utc.timestamp(), before.not_valid_after_utc.timestamp()
        self._identify(key, certificate, self.config().name, _due(begins, ends))

    def _identify(self, key: ec.EllipticCurvePrivateKey, certificate: str, name: str, until: float) -> None:
        if why := unfit(certificate, key, name, self.authority(), until):
            raise NodeError(
                f"what was sent is no certificate that this machine can be known by ({why}): it is not kept"
            )
        self._put(_IDENTITY, identity(key, x509.load_pem_x509_certificate(certificate.encode())))

    def names(self) -> dict[str, list[str]]:
        """Digests of images by the names that orchestrators pulled them by; of a damaged file none."""
        try:
            return TypeAdapter(dict[str, list[str]]).validate_json((self.folder / _NAMES).read_bytes())
        except (OSError, ValueError):
            return {}

    def save_names(self, names: Mapping[str, list[str]]) -> None:
        self._put(_NAMES, json.dumps(names, indent=1).encode() + b"\n")

    def clear(self) -> None:
        """Forget all of it."""
        for name in (_CONFIG, _IDENTITY, _AUTHORITY, _NAMES):
            (self.folder / name).unlink(missing_ok=True)
        if self.folder.is_dir() and not any(self.folder.iterdir()):
            self.folder.rmdir()

    def _put(self, name: str, content: bytes) -> None:
        """Complete or not at all, mode 0600, on the disk when it returns."""
        draft = self.folder / f"{name}.{secrets.token_hex(4)}"
        try:
            with open(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            draft.replace(self.folder / name)
        finally:
            draft.unlink(missing_ok=True)


def new_key() -> ec.EllipticCurvePrivateKey:
    """A key, which leaves this machine never."""
    return ec.generate_private_key(ec.SECP256R1())


def request_for(key: ec.EllipticCurvePrivateKey) -> str:
    """A request for a certificate for a key; whose it is the orchestrator knows."""
    made = x509.CertificateSigningRequestBuilder(x509.Name([])).sign(key, hashes.SHA256())
    return made.public_bytes(serialization.Encoding.PEM).decode()


def renew_due(begins: float, ends: float, now: float) -> bool:
    """Whether two thirds of a certificate's life are over; all by the orchestrator's clock [s]."""
    return now >= _due(begins, ends)


def _due(begins: float, ends: float) -> float:
    return begins + (ends - begins) * 2 / 3
