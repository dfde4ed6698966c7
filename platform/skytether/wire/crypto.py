"""Keys and ciphers. The only file that touches `cryptography`.

One 256-bit session key (made by the orchestrator) proves both ends. Handshake messages are sealed under keys
derived from it and 32 fresh random bytes, so that their nonce 0 is never used twice with one key; data keys also
depend on an ephemeral X25519 exchange, so that a session key stolen later opens no recorded traffic.
"""

from __future__ import annotations

import hashlib

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

KEY_SIZE = 32
SALT_SIZE = 32
TAG_SIZE = 16
RESUME_SIZE = 8
_LABEL = b"skytether 1 "


class Ciphers:
    """What one handshake gave: a key to seal with, a key to open with, and a public name for the pair."""

    __slots__ = ("_open", "_seal", "resume")

    def __init__(self, seal_key: bytes, open_key: bytes, resume: bytes) -> None:
        self._seal = AESGCM(seal_key)
        self._open = AESGCM(open_key)
        self.resume = resume
        """Tells the peer which keys this end still holds without telling anything of the keys."""

    def seal(self, number: int, plaintext: bytes, common: bytes) -> bytes:
        """Seal one message; ``number`` must never have been used with these keys."""
        return self._seal.encrypt(number.to_bytes(12, "big"), plaintext, common)

    def seal_into(self, number: int, plaintext: bytes, common: bytes, out: memoryview) -> None:
        """The same into a buffer of ``len(plaintext) + TAG_SIZE`` bytes."""
        self._seal.encrypt_into(number.to_bytes(12, "big"), plaintext, common, out)

    def open(self, number: int, sealed: memoryview | bytes, common: memoryview | bytes) -> bytes | None:
        """Plaintext, or None if it is not authentic."""
        try:
            return self._open.decrypt(number.to_bytes(12, "big"), sealed, common)
        except (InvalidTag, ValueError):
            return None


def derive(secret: bytes, salt: bytes, info: bytes, length: int = KEY_SIZE) -> bytes:
    """HKDF-SHA256 (RFC 5869)."""
    return HKDF(SHA256(), length, salt, _LABEL + info).derive(secret)


def seal_once(key: bytes, plaintext: bytes, common: bytes) -> bytes:
    """Seal under a key that is used for this one message only."""
    return AESGCM(key).encrypt(bytes(12), plaintext, common)


def open_once(key: bytes, sealed: memoryview | bytes, common: bytes) -> bytes | None:
    """Plaintext of `seal_once`, or None if it is not authentic."""
    try:
        return AESGCM(key).decrypt(bytes(12), sealed, common)
    except (InvalidTag, ValueError):
        return None


def public_of(private: bytes) -> bytes:
    """X25519 public key of 32 random bytes."""
    return X25519PrivateKey.from_private_bytes(private).public_key().public_bytes_raw()


def exchange(private: bytes, peer_public: bytes) -> bytes | None:
    """X25519 shared secret, or None for a public key that would make it a constant."""
    try:
        return X25519PrivateKey.from_private_bytes(private).exchange(X25519PublicKey.from_public_bytes(peer_public))
    except ValueError:
        return None


def data_keys(key: bytes, shared: bytes, hello: bytes, welcome: bytes) -> tuple[bytes, bytes, bytes]:
    """Keys robot to service and service to robot, and the name of the pair, bound to both handshake messages."""
    transcript = hashlib.sha256(hashlib.sha256(hello).digest() + hashlib.sha256(welcome).digest()).digest()
    material = derive(key + shared, transcript, b"data", 2 * KEY_SIZE + RESUME_SIZE)
    return material[:KEY_SIZE], material[KEY_SIZE : 2 * KEY_SIZE], material[2 * KEY_SIZE :]
