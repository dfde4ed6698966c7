"""One end. Reads lines of JSON: what to be, then measurements; says ``started``, ``connected``, then what it noted."""

from __future__ import annotations

import json
import os
import sys
import time
from typing import Any

from .graph import Flow, Graph, Wanted
from .schedule import Journal, Order

_LOOK_S = 0.01


def _main() -> None:
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # libraries write to standard output; answers only go where answers are read

    def send(answer: Any) -> None:
        answers.write(json.dumps(answer) + "\n")

    told = json.loads(sys.stdin.readline())
    wanted = Wanted(**{**told, "flows": [Flow(**flow) for flow in told["flows"]]})
    journal = Journal(wanted.receives)
    graph = _join(wanted, journal)
    send("started")
    while not graph.connected():
        time.sleep(_LOOK_S)
    send("connected")
    for line in sys.stdin:
        order = json.loads(line)
        order["flows"] = [Flow(**flow) for flow in order["flows"]]
        sends = order.pop("sends")
        sent, used = journal.measure(Order(**order), sends, graph.publish)
        send({"sent": sent, "received": journal.received, "cpu_s": used})
    graph.close()


def _join(wanted: Wanted, journal: Journal) -> Graph:
    if wanted.kind == "cyclonedds":
        from .with_cyclone import CycloneGraph

        return CycloneGraph(wanted, journal.deliver)
    if wanted.kind == "typed":
        from .typed import TypedGraph

        return TypedGraph(wanted, journal.deliver)
    from .with_rclpy import RclpyGraph

    return RclpyGraph(wanted, journal.deliver)


_main()
