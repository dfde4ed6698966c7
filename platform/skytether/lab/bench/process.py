"""What runs in the processes of a measurement: one end of a transport, or the emulator between them.

Each talks with the harness through one pipe and ends when that is closed, so none outlives the harness.
"""

from __future__ import annotations

import os
import signal
import time
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from skytether.emulator.link_model import LinkConditions
from skytether.emulator.udp_link import LinkEmulator, keep_time
from skytether.lab.netns import enter
from skytether.lab.tun import TunEmulator
from skytether.wire.topic import Role

from .ros2_program.schedule import Journal, Order
from .rows import Notes
from .transports import EndSpec, Program, Transport, load

_CONNECT_S = 15.0
_LOOK_S = 0.01


def run_end(pipe: Connection, transport: str, spec: EndSpec, namespace: str | None) -> None:
    """Be one end: start, report ``started`` and ``connected``, then measure on each order until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the harness decides when this ends
    with suppress(EOFError, BrokenPipeError):
        try:
            if namespace is not None:
                enter(namespace)
            kind = load(transport)
            end = kind(spec) if issubclass(kind, Program) else _Within(kind, spec)
        except Exception as error:
            pipe.send(error)
            return
        try:
            _serve(end, spec.role, pipe)
        finally:
            end.stop()


def _serve(end: Program | _Within, role: Role, pipe: Connection) -> None:
    try:
        end.start()
        pipe.send("started")
        deadline = time.monotonic() + _CONNECT_S
        while not end.connected():
            if time.monotonic() > deadline:
                raise TimeoutError(f"the {role}'s end did not connect within {_CONNECT_S:.0f} s")
            time.sleep(_LOOK_S)
        pipe.send("connected")
        while True:
            pipe.send(end.measure(pipe.recv()))
    except (EOFError, BrokenPipeError):
        raise
    except Exception as error:
        pipe.send(error)


class _Within:
    """An end whose transport works within this process."""

    def __init__(self, kind: type[Transport], spec: EndSpec) -> None:
        self._spec = spec
        self._journal = Journal(spec.receives)
        self._transport = transport = kind(spec, self._journal.deliver)
        self.start, self.connected, self.stop = transport.start, transport.connected, transport.stop

    def measure(self, order: Order) -> Notes:
        keep_time()
        sent, used = self._journal.measure(order, self._spec.sends, self._transport.publish)
        return Notes(sent, {i: list(arrivals) for i, arrivals in self._journal.received.items()}, used)


def run_emulator(pipe: Connection, kind: str, link: LinkConditions, options: dict[str, Any]) -> None:
    """Be the link: report how to reach it, then answer with the moment and its counters until the pipe closes.

    ``tun`` reports the paths of the robot's and the service's namespace, ``user`` its address.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(OSError):  # a link does not wait for a processor; without the privilege it sometimes must
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    with suppress(EOFError, BrokenPipeError):
        try:
            emulator: LinkEmulator | TunEmulator
            if kind == "tun":
                emulator = TunEmulator(up=link, down=link)
                for namespace in (emulator.robot, emulator.service):
                    namespace.sysctl("net.ipv4.tcp_congestion_control", options["congestion"])
            else:
                emulator = LinkEmulator(options["target"], up=link, down=link)
        except Exception as error:
            pipe.send(error)
            return
        with emulator:
            if isinstance(emulator, TunEmulator):
                pipe.send((emulator.robot.path, emulator.service.path))
            else:
                pipe.send(emulator.address)
            while True:
                pipe.recv()
                pipe.send((time.monotonic(), emulator.counters()))
