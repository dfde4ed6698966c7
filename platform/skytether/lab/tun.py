"""An emulated link for whole programs: two network namespaces, joined by IP packets that pass through here.

Each namespace has a TUN device; what one end's kernel sends into it is read here, delayed or lost as `link_model`
decides, and handed to the other's. So TCP, UDP and QUIC all meet the same link, and IP fragments are lost one by
one. Needs root and Linux; `link` is the emulator for everybody else, for UDP only.
"""

from __future__ import annotations

import fcntl
import heapq
import itertools
import os
import select
import struct
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

from skytether.emulator.link_model import IP_UDP_HEADERS, LinkConditions, LinkCounters, LinkModel
from skytether.emulator.udp_link import keep_time

from .netns import Namespace, NetworkError

ROBOT = "10.77.0.1"
"""Address of the robot's end, in its namespace."""
SERVICE = "10.77.0.2"
MTU = 1500

_TUNSETIFF = 0x400454CA
_IFF_TUN = 0x0001
_IFF_NO_PI = 0x1000
_REQUEST = struct.Struct("16sH22x")
_DEVICE = "link0"
_QUEUE = "10000"
"""Packets that the kernel keeps while this thread is not running: what is lost must be the link's doing only."""
_TURN = 64
"""Packets taken from one device before those that are due are sent on."""


class TunEmulator:
    """Two namespaces with a bad link between them. Runs from its construction until `close`.

    Attributes:
        robot: Namespace with the address `ROBOT`.
        service: Namespace with the address `SERVICE`.
    """

    def __init__(self, *, up: LinkConditions | None = None, down: LinkConditions | None = None) -> None:
        """Make namespaces and devices, and start. "Up" is from the robot to the service.

        Raises:
            NetworkError: This needs root, `/dev/net/tun` and the program `ip`.
        """
        self._models = (LinkModel(up or LinkConditions(), "up"), LinkModel(down or LinkConditions(), "down"))
        with ExitStack() as undo:
            self.robot = undo.enter_context(Namespace())
            self.service = undo.enter_context(Namespace())
            devices = []
            for namespace, local, remote in ((self.robot, ROBOT, SERVICE), (self.service, SERVICE, ROBOT)):
                if Path("/proc/sys/net/ipv6").exists():  # its own messages would be counted among the measured ones
                    namespace.sysctl("net.ipv6.conf.default.disable_ipv6", "1")
                devices.append(namespace.run(_open_tun))
                undo.callback(os.close, devices[-1])
                namespace.ip("address", "add", local, "peer", remote, "dev", _DEVICE)
                namespace.ip("link", "set", _DEVICE, "mtu", str(MTU), "txqueuelen", _QUEUE, "up")
            self._devices = tuple(devices)
            self._wake_out, self._wake_in = os.pipe()
            undo.callback(os.close, self._wake_out)
            undo.callback(os.close, self._wake_in)
            self._undo = undo.pop_all()
        # Ordered by time, then by number, so that packets due at once keep their order.
        self._under_way: list[tuple[float, int, int, bytes]] = []
        self._numbers = itertools.count()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="tun", daemon=True)
        self._thread.start()

    def set(self, *, up: LinkConditions | None = None, down: LinkConditions | None = None) -> None:
        """Change the conditions of one direction or both, for packets that enter from now on (a cut: all)."""
        for model, conditions in zip(self._models, (up, down), strict=True):
            if conditions is not None:
                model.conditions = conditions

    def counters(self) -> dict[str, LinkCounters]:
        """What was done so far, by direction (``up``, ``down``); bytes are of IP packets without 28 of headers."""
        return {name: model.counters.copy() for name, model in zip(("up", "down"), self._models, strict=True)}

    def close(self) -> None:
        """Drop what is under way and remove devices and namespaces. May be called again."""
        if self._closing:
            return
        self._closing = True
        os.write(self._wake_in, b".")
        self._thread.join()
        self._undo.close()

    def __enter__(self) -> TunEmulator:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _run(self) -> None:
        keep_time()
        readers = [self._wake_out, *self._devices]
        while not self._closing:
            wait = max(0.0, self._under_way[0][0] - time.monotonic()) if self._under_way else None
            for descriptor in select.select(readers, (), (), wait)[0]:
                if descriptor != self._wake_out:
                    self._receive(self._devices.index(descriptor))
            self._forward(time.monotonic())

    def _receive(self, end: int) -> None:
        """Take what one end sends and decide its way. Model and device have the sender's number."""
        model, device = self._models[end], self._devices[end]
        for _ in range(_TURN):
            try:
                packet = os.read(device, 65_535)
            except BlockingIOError:
                return
            # The model adds the headers of a UDP datagram; this is an IP packet already.
            for due in model.decide(len(packet) - IP_UDP_HEADERS, time.monotonic()):
                heapq.heappush(self._under_way, (due, next(self._numbers), end, packet))

    def _forward(self, now: float) -> None:
        """Hand on what is due."""
        while self._under_way and self._under_way[0][0] <= now:
            due, _, end, packet = heapq.heappop(self._under_way)
            model = self._models[end]
            counters = model.counters
            if model.conditions.cut:
                counters.cut += 1
                continue
            try:
                os.write(self._devices[1 - end], packet)
            except OSError:
                counters.failed += 1
                continue
            now = time.monotonic()
            counters.forwarded += 1
            counters.bytes_forwarded += len(packet) - IP_UDP_HEADERS
            counters.late_total += now - due
            counters.late_max = max(counters.late_max, now - due)


def _open_tun() -> int:
    """Make a TUN device in this thread's namespace; it ends with the descriptor."""
    try:
        device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise NetworkError(f"/dev/net/tun cannot be opened ({error.strerror}): run as root") from error
    try:
        fcntl.ioctl(device, _TUNSETIFF, _REQUEST.pack(_DEVICE.encode(), _IFF_TUN | _IFF_NO_PI))
    except OSError as error:
        os.close(device)
        raise NetworkError(f"no TUN device can be made ({error.strerror}): run as root") from error
    return device
