"""Keys and ciphers. The only file that touches `cryptography`.

One 256-bit session key (made by the orchestrator) proves both ends. Handshake messages are sealed under keys
derived from it and 32 fresh random bytes, so that their nonce 0 is never used twice with one key; data keys also
depend on an ephemeral X25519 exchange, so that a session key stolen later opens no recorded traffic.

Of each handshake every direction has keys of its own: one seals large messages (nonce: message number), one seals
packets with a whole message each (nonce: path and packet number), two more are for the tags of shards (`tags`).
"""

from __future__ import annotations

import hashlib

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.ciphers import Cipher, CipherContext
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from cryptography.hazmat.primitives.ciphers.algorithms import AES
from cryptography.hazmat.primitives.ciphers.modes import CTR, ECB
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

KEY_SIZE = 32
SALT_SIZE = 32
TAG_SIZE = 16
RESUME_SIZE = 8
ID_SIZE = 8
BLOCK_ROOM = 15
"""Bytes that `block_cipher`'s ``update_into`` wants beyond what it writes."""
_LABEL = b"skytether 2 "


class Aead:
    """AES-256-GCM under one key. No nonce may ever be used twice to seal."""

    __slots__ = ("_cipher",)

    def __init__(self, key: bytes) -> None:
        self._cipher = AESGCM(key)

    def seal(self, nonce: bytes, plaintext: bytes, data: bytes) -> bytes:
        """Ciphertext and tag; ``data`` is authenticated as well."""
        return self._cipher.encrypt(nonce, plaintext, data)

    def seal_into(self, nonce: bytes, plaintext: bytes, data: bytes, out: memoryview) -> None:
        """The same into a buffer of ``len(plaintext) + TAG_SIZE`` bytes."""
        self._cipher.encrypt_into(nonce, plaintext, data, out)

    def open(self, nonce: bytes, sealed: memoryview | bytes, data: memoryview | bytes) -> bytes | None:
        """Plaintext, or None if it is not authentic."""
        try:
            return self._cipher.decrypt(nonce, sealed, data)
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
    """Secrets robot to service and service to robot, and the name of the pair, bound to both handshake messages."""
    transcript = hashlib.sha256(hashlib.sha256(hello).digest() + hashlib.sha256(welcome).digest()).digest()
    material = derive(key + shared, transcript, b"data", 2 * KEY_SIZE + RESUME_SIZE)
    return material[:KEY_SIZE], material[KEY_SIZE : 2 * KEY_SIZE], material[2 * KEY_SIZE :]


def packet_id(key: bytes, shared: bytes, hello: bytes) -> int:
    """Id that packets of a handshake have: nobody else can tell to which session or handshake it belongs."""
    return int.from_bytes(derive(key + shared, hashlib.sha256(hello).digest(), b"id", ID_SIZE))


def short_mac(key: bytes, data: bytes, size: int) -> bytes:
    """Keyed BLAKE2s, for what is rare: needs no nonce."""
    return hashlib.blake2s(data, key=key, digest_size=size).digest()


def block_cipher(key: bytes) -> CipherContext:
    """AES on any number of whole blocks, each by itself; no mode of operation, so not for secrets."""
    return Cipher(AES(key), ECB()).encryptor()  # noqa: S305 - a pseudo-random function is what is wanted


def key_stream(key: bytes, size: int) -> bytes:
    """So many pseudo-random bytes; more of the same key begin with those."""
    return Cipher(AES(key), CTR(bytes(16))).encryptor().update(bytes(size))
