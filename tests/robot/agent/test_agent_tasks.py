"""The agent with a task manager: what is decided is what is asked for."""

import json
import threading
import time
from collections import deque
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from skytether.api.client import Unreachable
from skytether.api.rest import Placement
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig
from skytether.robot.offload.site_prober import TaskConfig
from skytether.robot.offload.task_manager import Mode, Policy

CONFIG = AgentConfig(
    robot="walker", url="https://nowhere", token="old", service="guide", fallback="admittance", renew_s=0.01
)
AT_ONCE = Policy(bad_s=0.0, hold_s=0.0, local_cpu=0.0)
"""Decides without hysteresis, and however busy the machine is."""


@pytest.fixture
def start(base, orchestrator):
    """Starts an agent that probes two sites."""
    orchestrator.rtt = {"edge": 0.01, "cloud": 0.05}
    started = []

    def start():
        task = TaskConfig(AT_ONCE, probe_s=0.005, battery=lambda: None)
        started.append(Agent(replace(CONFIG, task=task), base, client=orchestrator))
        started[-1].start()
        return started[-1]

    yield start
    for agent in started:
        agent.close()


def until(condition):
    end = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def preferred(request):
    return [site for site, measured in request.measurements.items() if measured.preferred]


def test_the_preferred_site_is_asked_for(start, orchestrator):
    orchestrator.fail = Unreachable("away")
    agent = start()
    until(lambda: preferred(orchestrator.requests[-1]) == ["edge"])
    assert orchestrator.requests[-1].measurements["cloud"].rtt_ms == 50.0
    assert agent.status().decision.site == "edge"


def test_mode_local_asks_for_nothing(base, orchestrator):
    local = TaskConfig(Policy(mode=Mode.LOCAL))
    agent = Agent(replace(CONFIG, task=local), base, client=orchestrator, clock=lambda: 50.0)
    assert agent.ask() > 0
    assert orchestrator.calls == []
    agent.tick(50.01)
    assert agent.status().driver.source == "fallback"


def test_a_decision_for_local_lets_the_instance_and_its_session_go(start, orchestrator):
    agent = start()
    until(lambda: agent.status().instance and agent.status().decision.site == "edge")
    orchestrator.rtt = {"edge": 9.0, "cloud": 9.0}
    until(lambda: not agent.status().decision.offload)
    until(lambda: agent.status().instance is None)
    until(lambda: orchestrator.calls[-1] == ("delete", "i1"))
    assert len(orchestrator.requests) == 1


def test_an_instance_elsewhere_is_wanted_when_it_was_so_decided(start, orchestrator):
    orchestrator.placement = Placement(site="cloud")
    orchestrator.changes = {"i2": {"placement": Placement(site="edge")}}
    start()
    until(lambda: len(orchestrator.requests) == 2)
    assert preferred(orchestrator.requests[-1]) == ["edge"]
    until(lambda: orchestrator.calls[-1][0] == "renew")
    assert ("delete", "i1") not in orchestrator.calls, "it is kept until the other one serves"


def test_a_refused_token_is_read_again_from_where_it_came(base):
    sent, tokens = [], deque(["old", "new", "new"])

    class Refuses(BaseHTTPRequestHandler):
        def do_POST(self):
            self.rfile.read(int(self.headers["Content-Length"]))
            sent.append(self.headers["Authorization"])
            body = json.dumps({"title": "no", "status": 401, "detail": "the token has expired"}).encode()
            self.send_response(401)
            self.send_header("Content-Type", "application/problem+json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Refuses) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        url = f"http://127.0.0.1:{server.server_address[1]}"
        agent = Agent(replace(CONFIG, url=url, fresh_token=tokens.popleft), base, clock=lambda: 50.0)
        assert agent.ask() == 10.0, "the file holds the same"
        assert agent.ask() < 1.0
        assert agent.ask() == 10.0
        assert "the token has expired" in agent.status().trouble
        agent.close()
        server.shutdown()
    assert sent == ["Bearer old", "Bearer old", "Bearer new"]
