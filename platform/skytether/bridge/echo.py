"""A UDP echo: where a robot measures round trip, loss and packet size towards a machine, and learns how it is seen.

Datagrams only, no session: ``SKYECHO?``, 8 bytes that the asker chose, 8 bytes of the answer before (zeros: there was
none), padding; the answer is ``SKYECHO!``, the same 8 bytes, the address and port that the question came from (16 bytes
of IPv6, IPv4 mapped into it; 2 bytes), 8 bytes for the next question, and padding to the size of the question. An
answer is never longer than its question, so the echo amplifies nothing; and an address gets so little each second that
nobody is flooded by answers to questions that another sent in his name. Whoever has had an answer, as those 8 bytes
show, has an allowance apart, which no such questions use up.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import ipaddress
import os
import socket
import struct
import threading
import time
from collections import OrderedDict
from dataclasses import dataclass
from types import TracebackType
from typing import Any

from .datagrams import IP_MTU_DISCOVER, IPV6_MTU_DISCOVER, PMTUDISC_DO
from .relay_table import Bucket

SMALLEST = 64
"""Bytes of a question; shorter ones are not answered."""
LARGEST = 9000
ADDRESS_RATE, ADDRESS_BURST = 32_000, 128_000
"""Bytes a second, and at once, to one address: several times what `skytether doctor` and a probing robot ask for."""
RATE = 4_000_000
"""The same to all together that have had an answer, and to all others."""
ADDRESSES = 4096
"""Addresses remembered."""
_ASK, _ANSWER = b"SKYECHO?", b"SKYECHO!"
_BODY = struct.Struct(">8s8s16sH8s")
_NONCE = 8
_COOKIE = 8
_ASKED = slice(len(_ASK) + _NONCE, len(_ASK) + _NONCE + _COOKIE)
"""Where a question has its cookie."""
_SAID = slice(_BODY.size - _COOKIE, _BODY.size)
"""Where an answer has it."""
_IPV4 = b"\0" * 10 + b"\xff\xff"


@dataclass(frozen=True, slots=True)
class Echo:
    """One answer.

    Attributes:
        rtt: Round trip [s].
        seen_as: Address and port that the other side saw.
    """

    rtt: float
    seen_as: tuple[str, int]


def answer(question: bytes, source: tuple[str, int], key: bytes = b"") -> bytes | None:
    """What the echo says to a datagram; None: nothing. ``key``: of its cookies."""
    if not SMALLEST <= len(question) <= LARGEST or not question.startswith(_ASK):
        return None
    try:
        address = ipaddress.ip_address(source[0].split("%")[0])
    except ValueError:
        return None
    packed = address.packed if address.version == 6 else _IPV4 + address.packed
    nonce = question[len(_ASK) : len(_ASK) + _NONCE]
    cookie = hashlib.blake2s(packed, key=key, digest_size=_COOKIE).digest()
    return _BODY.pack(_ANSWER, nonce, packed, source[1], cookie).ljust(len(question), b"\0")


def was_answered(question: bytes, said: bytes) -> bool:
    """Whether who asks has had an answer at this address before: nobody else can know its cookie."""
    return hmac.compare_digest(question[_ASKED], said[_SAID])


def read_answer(data: bytes, nonce: bytes) -> tuple[str, int] | None:
    """The address that an answer tells; None if it is no answer to this question."""
    if len(data) < _BODY.size:
        return None
    kind, echoed, packed, port, _ = _BODY.unpack_from(data)
    if kind != _ANSWER or echoed != nonce:
        return None
    address = ipaddress.IPv6Address(packed)
    return str(address.ipv4_mapped or address), port


class Allowance:
    """How much an echo may say, and to whom: an IPv4 address, or a network of 64 bits of IPv6."""

    def __init__(self, now: float) -> None:
        self._all = Bucket(RATE, RATE, now)
        self._addresses: OrderedDict[bytes, Bucket] = OrderedDict()

    def admit(self, said: bytes, now: float) -> bool:
        """Whether that may be said to the address that it names."""
        address = said[16:32]
        key = address if address.startswith(_IPV4) else address[:8]
        bucket = self._addresses.pop(key, None) or Bucket(ADDRESS_RATE, ADDRESS_BURST, now)
        self._addresses[key] = bucket
        if len(self._addresses) > ADDRESSES:
            self._addresses.popitem(last=False)
        return bucket.consume(len(said), now) and self._all.consume(len(said), now)


class EchoServer:
    """Answers in a thread of its own until `close`.

    Attributes:
        address: Host and port where it listens.
        refused: Questions that were not answered because there were too many.
    """

    def __init__(self, host: str, port: int) -> None:
        """Bind and begin.

        Raises:
            OSError: The port is taken, or the address is not this machine's.
        """
        self._socket = _open(host, port)
        name = self._socket.getsockname()
        self.address: tuple[str, int] = (name[0], name[1])
        self.refused = 0
        self._closing = False
        self._thread = threading.Thread(target=self._run, name=f"echo-{name[1]}", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        self._socket.settimeout(0.2)
        key = os.urandom(32)
        strangers, known = Allowance(time.monotonic()), Allowance(time.monotonic())
        while not self._closing:
            try:
                question, source = self._socket.recvfrom(LARGEST + 1)
            except TimeoutError:
                continue
            except OSError:  # an ICMP answer to something sent before
                continue
            said = answer(question, source[:2], key)
            if said is None:
                continue
            allowance = known if was_answered(question, said) else strangers
            if allowance.admit(said, time.monotonic()):
                with contextlib.suppress(OSError):  # larger than the way back takes: silence says so
                    self._socket.sendto(said, source)
            else:
                self.refused += 1

    def close(self) -> None:
        """End. May be called again."""
        self._closing = True
        self._thread.join()
        self._socket.close()

    def __enter__(self) -> EchoServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class EchoClient:
    """Asks one echo, from one port. Not for several threads at once."""

    def __init__(self, host: str, port: int) -> None:
        """Open a socket that never sends fragments.

        Raises:
            OSError: The name has no address.
        """
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        self._peer: Any = address
        self._cookie = bytes(_COOKIE)
        self._socket = socket.socket(family, kind, protocol)
        _never_fragment(self._socket)

    def ask(self, timeout: float, size: int = SMALLEST) -> Echo | None:
        """One question.

        Args:
            timeout: To wait for the answer [s].
            size: Of question and answer, bytes of UDP payload.

        Returns:
            The answer; None if none came in time, or the question is larger than this machine's network takes.
        """
        nonce = os.urandom(_NONCE)
        began = time.monotonic()
        try:
            self._socket.sendto((_ASK + nonce + self._cookie).ljust(size, b"\0"), self._peer)
            while (left := began + timeout - time.monotonic()) > 0:
                self._socket.settimeout(left)
                data = self._socket.recv(LARGEST)
                seen = read_answer(data, nonce)
                if seen is not None:
                    self._cookie = data[_SAID]
                    return Echo(time.monotonic() - began, seen)
        except OSError:  # a time-out, no route, nobody there, or "message too long"
            return None
        return None

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def __enter__(self) -> EchoClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _open(host: str, port: int) -> socket.socket:
    family, kind, protocol, _, address = socket.getaddrinfo(
        host, port, type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE
    )[0]
    sock = socket.socket(family, kind, protocol)
    try:
        _never_fragment(sock)
        sock.bind(address)
    except BaseException:
        sock.close()
        raise
    return sock


def _never_fragment(sock: socket.socket) -> None:
    level, option = (
        (socket.IPPROTO_IPV6, IPV6_MTU_DISCOVER)
        if sock.family == socket.AF_INET6
        else (socket.IPPROTO_IP, IP_MTU_DISCOVER)
    )
    with contextlib.suppress(OSError):  # systems other than Linux
        sock.setsockopt(level, option, PMTUDISC_DO)
