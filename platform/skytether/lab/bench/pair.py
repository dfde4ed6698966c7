"""Two ends of a transport and the link between them, each in a process of its own, as the harness holds them."""

from __future__ import annotations

import contextlib
import multiprocessing
import socket
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any

from skytether.emulator.link_model import IP_UDP_HEADERS, LinkConditions, LinkCounters
from skytether.lab.tun import SERVICE
from skytether.wire.topic import Role

from .process import run_emulator, run_end
from .ros2_program.schedule import Order
from .rows import Carried, Row, Run, make_rows
from .traffic import Flow
from .transports import EndSpec, load

LOOPBACK = "127.0.0.1"
_PORT = 7400
_LEAD_S = 0.1
"""For an order to reach both ends before it begins."""
_STOP_S = 1.0
"""For a process to end by itself; one in the midst of a measurement does not, and holds nothing worth waiting for."""


class BenchError(Exception):
    """Nothing could be measured; the text says why."""


class Pair:
    """A transport, connected and ready to be measured, once or several times."""

    def __init__(
        self,
        transport: str,
        flows: Sequence[Flow],
        *,
        condition: str,
        link: LinkConditions | None,
        emulator: str,
        congestion: str,
        options: dict[str, Any] | None = None,
    ) -> None:
        """Start everything; returns once both ends are connected.

        Args:
            transport: Its name.
            flows: What its session carries.
            condition: Name of the link.
            link: What the link does; None for no emulator, on loopback.
            emulator: ``tun`` or ``user``; for a link.
            congestion: Of TCP, in namespaces.
            options: For the transport.

        Raises:
            BenchError: An end or the emulator cannot work here.
        """
        self._transport = transport
        self._flows = tuple(flows)
        self._condition = condition
        self._emulator = emulator if link is not None else "none"
        self._congestion = congestion if load(transport).TCP else None
        self._link: Connection | None = None
        with ExitStack() as undo:
            folder = undo.enter_context(tempfile.TemporaryDirectory(prefix="skytether-bench-"))
            listen, connect = (LOOPBACK, free_port()), (LOOPBACK, 0)
            robot_space = service_space = None
            if link is None:
                connect = listen
            elif emulator == "tun":
                self._link = _start(undo, run_emulator, emulator, link, {"congestion": congestion})
                robot_space, service_space = self._receive(self._link)
                listen = connect = (SERVICE, _PORT)
            else:
                self._link = _start(undo, run_emulator, emulator, link, {"target": listen})
                connect = self._receive(self._link)
            made = (listen, Role.SERVICE, service_space), (connect, Role.ROBOT, robot_space)
            ends = []
            for address, role, namespace in made:
                spec = EndSpec(role, address, self._flows, folder, options or {})
                ends.append(_start(undo, run_end, transport, spec, namespace))
                self._receive(ends[-1])
            self._service, self._robot = ends
            for end in ends:
                self._receive(end)
            self._undo = undo.pop_all()

    def measure(
        self, seconds: float, *, flows: Sequence[Flow] | None = None, condition: str | None = None, warm_up: float = 1.0
    ) -> list[Row]:
        """Send for so long, and count.

        Args:
            seconds: Of what counts.
            flows: Other sizes and rates of the same topics.
            condition: Another name for the rows.
            warm_up: Seconds of the same traffic before it counts.

        Raises:
            BenchError: An end failed.
        """
        chosen = tuple(flows) if flows is not None else self._flows
        begin = time.monotonic() + _LEAD_S
        order = Order(chosen, begin, begin + warm_up, begin + warm_up + seconds)
        for end in (self._robot, self._service):
            end.send(order)
        carried, late = self._carried(order)
        robot, service = self._receive(self._robot), self._receive(self._service)
        run = Run(
            self._transport,
            condition or self._condition,
            self._congestion,
            self._emulator,
            order.start,
            seconds,
            carried,
            late,
        )
        return make_rows(run, chosen, robot, service)

    def close(self) -> None:
        """End all processes."""
        self._undo.close()

    def __enter__(self) -> Pair:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _carried(self, order: Order) -> tuple[Carried | None, float | None]:
        """What enters the link, both ways, while the order counts, and the most that a packet was late [ms]; waits.

        None of either without a link.
        """
        if self._link is None:
            return None, None
        since, before, _ = self._counters_at(self._link, order.start)
        until, after, late = self._counters_at(self._link, order.end)
        return Carried(since, until, after - before), late

    def _counters_at(self, link: Connection, when: float) -> tuple[float, int, float]:
        """The moment, a bit late on a busy machine, and bytes of IP packets that had entered the link, both ways.

        And the most that one was late [ms].
        """
        time.sleep(max(0.0, when - time.monotonic()))
        link.send("counters")
        counted_at, counters = self._receive(link)
        both: list[LinkCounters] = list(counters.values())
        entered = sum(c.bytes_received + c.received * IP_UDP_HEADERS for c in both)
        return counted_at, entered, round(max(c.late_max for c in both) * 1000, 3)

    def _receive(self, pipe: Connection) -> Any:
        try:
            answer = pipe.recv()
        except EOFError:
            answer = BenchError("a process ended unexpectedly")
        if isinstance(answer, Exception):
            raise BenchError(f"{self._transport}, {self._condition}: {answer}") from answer
        return answer


def _start(undo: ExitStack, function: Any, *arguments: Any) -> Connection:
    """Start a process that ends when `undo` is closed."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=function, args=(theirs, *arguments), daemon=True)
    process.start()
    theirs.close()

    def stop() -> None:
        ours.close()
        process.join(_STOP_S)
        if process.is_alive():
            process.kill()
            process.join()

    undo.callback(stop)
    return ours


def free_port() -> int:
    """A UDP port of loopback that nobody has at the moment."""
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sock:
        sock.bind((LOOPBACK, 0))
        port: int = sock.getsockname()[1]
        return port
