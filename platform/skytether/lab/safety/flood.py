"""A program that writes to one of the gate's sockets as fast as it can: ``... flood KIND FOLDER SECONDS``."""

from __future__ import annotations

import random
import socket
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from itertools import cycle
from math import inf, nan
from pathlib import Path

import numpy as np

from skytether.guard.velocity import Velocity
from skytether.messages import encode
from skytether.robot.safety.client import GateLink

from .robot import scan_of

_CLIENTS = 64
_MANY_RAYS = 20_000
_SEED = 1


def main() -> None:
    """Flood until the time is over."""
    kind, folder, seconds = sys.argv[1], Path(sys.argv[2]), float(sys.argv[3])
    end = time.monotonic() + seconds
    for _ in _KINDS[kind](folder):
        if time.monotonic() > end:
            return


def _mad_agent(folder: Path) -> Iterator[None]:
    """Commands of an agent that has gone mad: too fast, no numbers, to and fro."""
    link = GateLink(folder)
    for velocity in cycle(
        Velocity(linear, angular) for linear in (5.0, nan, -5.0, 0.5, inf, 1e300, -0.1) for angular in (0.0, 9.0, nan)
    ):
        with suppress(OSError):
            link.send(velocity)
        yield


def _bytes(name: str) -> Callable[[Path], Iterator[None]]:
    """Datagrams that mean nothing."""

    def run(folder: Path) -> Iterator[None]:
        dice = random.Random(_SEED)
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
            link.setblocking(False)
            while True:
                with suppress(OSError):
                    link.sendto(dice.randbytes(dice.choice((0, 1, 44, 64, 500))), str(folder / name))
                yield

    return run


def _scans(folder: Path) -> Iterator[None]:
    """Scans of many rays, each a good one."""
    data = b"scan\0" + encode(scan_of(np.full(_MANY_RAYS, 5.0, dtype=np.float32), step=2 * np.pi / _MANY_RAYS))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4 * len(data))
        link.setblocking(False)
        while True:
            with suppress(OSError):
                link.sendto(data, str(folder / "sensors.sock"))
            yield


def _clients(folder: Path) -> Iterator[None]:
    """Clients that come, say something wrong or nothing, and go or stay."""
    dice = random.Random(_SEED)
    links: list[socket.socket] = []
    while True:
        for name in ("control.sock", "stop.sock"):
            link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            link.setblocking(False)
            with suppress(OSError):
                link.connect(str(folder / name))
                if dice.random() < 0.5:
                    link.send(dice.randbytes(100))
            links.append(link)
        while len(links) > _CLIENTS:
            links.pop(dice.randrange(len(links))).close()
        yield


_KINDS: Mapping[str, Callable[[Path], Iterator[None]]] = {
    "mad-agent": _mad_agent,
    "commands": _bytes("command.sock"),
    "readings": _bytes("sensors.sock"),
    "stops": _bytes("estop.sock"),
    "scans": _scans,
    "clients": _clients,
}


if __name__ == "__main__":
    main()
