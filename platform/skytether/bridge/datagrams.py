"""One UDP socket that moves many datagrams with a system call, where the kernel can.

Sends with ``UDP_SEGMENT`` (the kernel cuts one buffer into equal datagrams) and receives with ``UDP_GRO``
(it hands over equal datagrams in one buffer): Linux udp(7), kernel 4.18 and 5.0. Elsewhere, or when the
kernel refuses, datagram by datagram. Nothing is ever fragmented. Knows nothing of the protocol.
"""

from __future__ import annotations

import contextlib
import errno
import socket
import struct
import sys
import time
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

# Linux numbers that Python's socket module does not name.
UDP_SEGMENT = 103
UDP_GRO = 104
SO_SNDBUFFORCE = 32
SO_RCVBUFFORCE = 33
SO_TIMESTAMPNS = 35
IP_MTU_DISCOVER = 10
IPV6_MTU_DISCOVER = 23
PMTUDISC_DO = 2

MAX_SEGMENTS = 64
"""What every kernel with UDP_SEGMENT takes in one call (UDP_MAX_SEGMENTS)."""
MAX_PAYLOAD = 65_507
"""Largest UDP payload over IPv4, which bounds a batch too."""
SOCKET_BUFFER = 4 * 1024 * 1024
"""A burst must survive the time that other threads keep this one from running: 50 ms at 600 Mbit/s."""

MAX_DATAGRAM = 65_536
"""No datagram, and nothing that the kernel puts together, is larger."""
TOGETHER_NS = 50_000
"""Datagrams that came so soon after each other came at the same time to everybody who measures delays."""

Address = tuple[str, int] | tuple[str, int, int, int]

_SEGMENT_SIZE = struct.Struct("=H")
_GRO_SIZE = struct.Struct("=i")
_STAMP = struct.Struct("@ll")
"""Seconds and nanoseconds of the system's wall clock."""
_BILLION = 1_000_000_000
_ANCILLARY_SPACE = socket.CMSG_SPACE(_GRO_SIZE.size) + socket.CMSG_SPACE(_STAMP.size)
_NO_BATCHES = (errno.EINVAL, errno.EIO, errno.EOPNOTSUPP)
"""What a kernel or network device answers that cannot cut this batch."""


def grow_buffers(sock: socket.socket, size: int = SOCKET_BUFFER) -> None:
    """Ask for large kernel buffers, beyond the system's limit where privileges allow."""
    for force, plain in ((SO_RCVBUFFORCE, socket.SO_RCVBUF), (SO_SNDBUFFORCE, socket.SO_SNDBUF)):
        try:
            sock.setsockopt(socket.SOL_SOCKET, force, size)
        except OSError:
            sock.setsockopt(socket.SOL_SOCKET, plain, size)


class _Taken(NamedTuple):
    """What the kernel handed over, in the socket's buffer."""

    start: int
    size: int
    address: Address
    segment: int | None
    at: int
    """Nanoseconds of the wall clock; 0 where the kernel does not tell."""


class DatagramSocket:
    """A bound, non-blocking UDP socket.

    Attributes:
        address: Where it is bound: host and port.
        segmentation: Whether sending uses UDP_SEGMENT; becomes False once the kernel refuses.
        coalescing: Whether receiving uses UDP_GRO.
        errors: Datagrams or batches that the system refused, by name of the error (``EMSGSIZE``).
        too_large: Size of the latest datagram that was refused as larger than the path takes; None if none was.
        waited: Seconds for which what `receive` returned last had been in the kernel; 0 where that does not tell.
        drained: Whether the kernel had nothing more after what `receive` returned last.
    """

    def __init__(
        self,
        bind: tuple[str, int],
        *,
        device: str | None = None,
        batches: bool = True,
        kernel_buffer: int = SOCKET_BUFFER,
        scratch: memoryview | None = None,
    ) -> None:
        """Open and bind.

        Args:
            bind: Host (name or address, IPv4 or IPv6) and port; port 0 takes any free one.
            device: Network interface to send by, whatever the routes say; where the system permits.
            batches: False leaves the kernel's batching alone.
            kernel_buffer: Bytes that the kernel may hold, each way.
            scratch: 64 KiB to receive into, for sockets of one thread that share it; None: its own.

        Raises:
            OSError: The name cannot be resolved, the port is taken, or the address is not this machine's.
        """
        family, kind, protocol, _, address = socket.getaddrinfo(
            bind[0], bind[1], type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE
        )[0]
        self._asked = bind, device, batches, kernel_buffer, scratch
        self._socket = socket.socket(family, kind, protocol)
        try:
            self._socket.setblocking(False)
            grow_buffers(self._socket, kernel_buffer)
            self._never_fragment()
            if device is not None:
                with contextlib.suppress(OSError, AttributeError):
                    self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, device.encode())
            self.segmentation = batches and self._kernel_has(UDP_SEGMENT, 0)
            self.coalescing = batches and self._kernel_has(UDP_GRO, 1)
            if sys.platform == "linux":
                with contextlib.suppress(OSError):
                    self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
            self._socket.bind(address)
        except BaseException:
            self._socket.close()
            raise
        name = self._socket.getsockname()
        self.address: tuple[str, int] = (name[0], name[1])
        self.errors: Counter[str] = Counter()
        self.too_large: int | None = None
        self.waited = 0.0
        self.drained = False
        # room for one more while others are kept; what others share cannot keep anything
        self._buffer = memoryview(bytearray(2 * MAX_DATAGRAM)) if scratch is None else scratch
        self._next: _Taken | None = None
        """Taken already, and not of those that were returned last."""

    @property
    def family(self) -> int:
        """AF_INET or AF_INET6."""
        return self._socket.family

    def fileno(self) -> int:
        """For a selector."""
        return self._socket.fileno()

    def close(self) -> None:
        """Give the port back."""
        self._socket.close()

    def another(self) -> DatagramSocket | None:
        """One like it at another port; None: it was told which port, or the system has none."""
        bind, device, batches, kernel_buffer, scratch = self._asked
        if bind[1] != 0:
            return None
        try:
            return DatagramSocket(bind, device=device, batches=batches, kernel_buffer=kernel_buffer, scratch=scratch)
        except OSError:  # the network is gone
            return None

    def resolve(self, host: str, port: int, numeric: bool = False) -> Address:
        """Find the address of a peer that this socket can send to. May ask the name service, so it may block.

        Args:
            host: Name or address.
            port: UDP port.
            numeric: Take addresses only, and ask nobody.

        Raises:
            OSError: There is none of this socket's family.
        """
        family = self._socket.family
        flags = socket.AI_V4MAPPED if family == socket.AF_INET6 else 0
        if numeric:
            flags |= socket.AI_NUMERICHOST
        # typeshed allows for address families other than IP
        return socket.getaddrinfo(host, port, family=family, type=socket.SOCK_DGRAM, flags=flags)[0][4]  # type: ignore[return-value]

    def receive(self, ahead: bool = False) -> tuple[memoryview, Address, int | None] | None:
        """Take what the kernel has: one datagram, or several equal ones (the last may be shorter) from one address.

        Args:
            ahead: Where the kernel hands over one by one what came together, put it together here: to handle packets
                one by one costs several times as much. Whoever asks for it goes on until `drained`, or ends with a
                call that does not: one datagram may have been taken already. Not for sockets with shared ``scratch``.

        Returns:
            Data (valid until the next call), sender, and the size of each datagram if there are several;
            None if there is nothing more.
        """
        first, self._next = self._next or self._receive_one(0), None
        self.drained = first is None
        if first is None:
            return None
        start, size, address, segment, at = first
        self.waited = max(0.0, (time.time_ns() - at) / _BILLION) if at else 0.0
        end = start + size
        if ahead and segment is None and size:
            while end <= MAX_DATAGRAM and end - start < MAX_SEGMENTS * size:
                more = self._receive_one(end)
                if more is None:
                    self.drained = True
                    break
                if (more.size, more.address, more.segment) != (size, address, None) or more.at - at > TOGETHER_NS:
                    self._next = more
                    break
                end += size
            segment = size
        return self._buffer[start:end], address, segment if segment is not None and segment < end - start else None

    def _receive_one(self, start: int) -> _Taken | None:
        """Have the kernel write into the buffer from there on; None if it has nothing."""
        while True:
            try:
                size, ancillary, _, address = self._socket.recvmsg_into([self._buffer[start:]], _ANCILLARY_SPACE)
            except BlockingIOError:
                return None
            except OSError as error:  # an ICMP answer to something sent before; the next datagram is not affected
                self._count(error)
                continue
            segment, at = None, 0
            for level, kind, data in ancillary:
                if kind == UDP_GRO and level == socket.IPPROTO_UDP:
                    segment = _GRO_SIZE.unpack(data)[0]
                elif kind == SO_TIMESTAMPNS and level == socket.SOL_SOCKET:
                    seconds, nanoseconds = _STAMP.unpack(data)
                    at = seconds * _BILLION + nanoseconds
            return _Taken(start, size, address, segment if segment is not None and segment < size else None, at)

    def send(self, data: bytes | memoryview, address: Address, segment: int | None = None) -> int:
        """Send one datagram, or a batch that is cut into datagrams of `segment` bytes (the last may be shorter).

        What the network or the system refuses is dropped and counted in `errors`.

        Returns:
            Bytes disposed of, sent or dropped. Fewer than there are: the socket's buffer is full, wait until
            it is writable.
        """
        view = memoryview(data)
        done = 0
        for part in self._parts(len(view), segment):
            try:
                self._send_part(view[done : done + part], address, segment)
            except BlockingIOError:
                return done
            except OSError as error:
                if self.segmentation and segment is not None and part > segment and error.errno in _NO_BATCHES:
                    # Some kernels say the same of a path that is too small; a datagram by itself tells which it is.
                    alone = self._send_alone(view[done : done + segment], address)
                    if alone != errno.EMSGSIZE:
                        self.segmentation = False
                        done += 0 if alone == errno.EAGAIN else segment
                        return done + self.send(view[done:], address, segment)
                    error = OSError(alone, "message too long")
                if error.errno == errno.EMSGSIZE:
                    self.too_large = min(part, segment or part)
                self._count(error)
            done += part
        return done

    def _send_part(self, data: memoryview, address: Address, segment: int | None) -> None:
        if segment is None or len(data) <= segment:
            self._socket.sendto(data, address)
        else:
            control = (socket.IPPROTO_UDP, UDP_SEGMENT, _SEGMENT_SIZE.pack(segment))
            self._socket.sendmsg([data], [control], 0, address)

    def _send_alone(self, datagram: memoryview, address: Address) -> int:
        """Send one datagram of a batch that was refused; returns the system's answer, 0 if it was sent."""
        try:
            self._socket.sendto(datagram, address)
        except OSError as error:
            return error.errno or 0
        return 0

    def _parts(self, size: int, segment: int | None) -> Iterator[int]:
        """Sizes of what one system call each may take."""
        if segment is None:
            yield size
            return
        most = min(MAX_SEGMENTS, MAX_PAYLOAD // segment) * segment if self.segmentation else segment
        for start in range(0, size, most):
            yield min(most, size - start)

    def _kernel_has(self, option: int, value: int) -> bool:
        try:
            self._socket.setsockopt(socket.IPPROTO_UDP, option, value)
        except OSError:
            return False
        return True

    def _never_fragment(self) -> None:
        # A system without the option fragments nothing of the sizes that the protocol sends by default.
        with contextlib.suppress(OSError):
            if self._socket.family == socket.AF_INET6:
                self._socket.setsockopt(socket.IPPROTO_IPV6, IPV6_MTU_DISCOVER, PMTUDISC_DO)
                # An IPv4 peer of a dual-stack socket goes by the IPv4 option.
                self._socket.setsockopt(socket.IPPROTO_IP, IP_MTU_DISCOVER, PMTUDISC_DO)
            else:
                self._socket.setsockopt(socket.IPPROTO_IP, IP_MTU_DISCOVER, PMTUDISC_DO)

    def _count(self, error: OSError) -> None:
        self.errors[errno.errorcode.get(error.errno or 0, "unknown")] += 1
