"""The world in a browser window, in real time: a page on loopback that draws what it is told ten times a second.

Nothing can be changed from there: the server answers GET only, and only under the name of this machine itself, so that
no page from elsewhere reads it.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any

from .guide import Guide
from .picture import frame
from .plan import Plan
from .simulation import TICK, Simulation

_CATCH_UP_S = 0.5
"""A machine that was held up for longer goes on from there."""
_RAYS = 5
"""Every so many rays are told."""


def serve(
    simulation: Simulation, port: int, on_ready: Callable[[str], None], ended: threading.Event | None = None
) -> None:
    """Drive the first robot round and round in real time, until interrupted.

    Args:
        simulation: Not begun.
        port: On 127.0.0.1; 0: any free one.
        on_ready: Told the page's address.
        ended: Ends it when set.

    Raises:
        OSError: The port is taken.
    """
    ended = ended or threading.Event()
    state = {"text": json.dumps(snapshot(simulation))}
    page = files(__package__).joinpath("live.html").read_bytes()
    plan = json.dumps(plan_document(simulation.plan, simulation.params.footprint())).encode()

    class Handler(BaseHTTPRequestHandler):
        timeout = 5.0

        def do_GET(self) -> None:
            host = self.headers.get("Host", "").rpartition(":")[0]
            answers = {
                "/": ("text/html; charset=utf-8", page),
                "/plan": ("application/json", plan),
                "/state": ("application/json", state["text"].encode()),
            }
            if host not in ("127.0.0.1", "localhost") or self.path not in answers:
                self.send_error(404)
                return
            kind, body = answers[self.path]
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
            """Nobody reads it."""

    server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, name="live", daemon=True)
    thread.start()
    try:
        on_ready(f"http://127.0.0.1:{server.server_address[1]}/")
        _drive(simulation, state, ended)
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _drive(simulation: Simulation, state: dict[str, str], ended: threading.Event) -> None:
    robot, guide = simulation.robots[0], Guide(simulation.plan.goals, simulation.params)
    due = time.monotonic()
    while not ended.is_set():
        if guide.done:
            guide = Guide(simulation.plan.goals, simulation.params)
        robot.write(guide.step(robot.pose, robot.scan))
        simulation.tick()
        if simulation.ticks % 10 == 0:
            state["text"] = json.dumps(snapshot(simulation))
        due = max(due + TICK, time.monotonic() - _CATCH_UP_S)
        ended.wait(max(0.0, due - time.monotonic()))


def plan_document(plan: Plan, footprint: tuple[tuple[float, float], ...]) -> dict[str, Any]:
    """What stands there, for the page [m, rad]."""
    return {
        "name": plan.name,
        "bounds": plan.bounds(),
        "footprint": footprint,
        "boxes": [{"corners": box.corners().tolist(), "wall": box.wall, "mapped": box.mapped} for box in plan.boxes],
        "cylinders": [{"x": c.x, "y": c.y, "radius": c.radius, "mapped": c.mapped} for c in plan.cylinders],
        "goals": [list(goal) for goal in plan.goals],
    }


def snapshot(simulation: Simulation) -> dict[str, Any]:
    """What is now, for the page [s, m, rad]."""
    now = frame(simulation)
    return {
        "time": round(now.time, 2),
        "robots": [[round(v, 3) for v in pose] for pose in now.poses],
        "people": [[[round(v, 3) for v in part] for part in stance] for stance in now.people],
        "hits": now.hits[::_RAYS].round(3).tolist(),
        "contacts": len(simulation.contacts),
    }
