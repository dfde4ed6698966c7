import json
import socket
import threading
from contextlib import ExitStack, suppress
from dataclasses import replace

import httpx
import pytest
from typer.testing import CliRunner

from skytether.api.rest import Placement, Session
from skytether.cli.app import app
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig
from skytether.robot.agent.diagnostics import Level, diagnostics
from skytether.robot.agent.status import StatusServer, document, metrics
from skytether.robot.offload.site_prober import TaskConfig
from skytether.robot.offload.task_manager import Option
from skytether.ros.followed import Followed
from skytether.wire.stats import PathStats, SessionStats, TopicStats

CONFIG = AgentConfig(
    robot="walker", url="", token="secret", service="guide", fallback="admittance", task=TaskConfig(), status_port=0
)


@pytest.fixture
def agent(base, orchestrator, bridge):
    """After a while: it has an instance and a bridge."""
    orchestrator.placement = Placement(site="edge")
    orchestrator.session = Session(id="00000000000000ab", key=orchestrator.KEY, host="10.0.0.1", port=4000)
    topic = TopicStats("cmd_vel", "out", 127, delivered=40, delay_p50=0.02)
    bridge.snapshot = SessionStats(True, (topic,), (PathStats(0, None, rtt=0.04, mtu=1400),))
    agent = Agent(CONFIG, base, client=orchestrator, bridge=lambda *_: bridge, clock=lambda: 50.0)
    agent.ask()
    for i in range(10):
        agent.tick(50.0 + i / 100)
    agent.watch(50.1)
    return agent


@pytest.fixture
def status(agent):
    """That agent's, with a decision."""
    options = (Option("edge", {"delay": 0.3, "loss": 0.1}), Option("cloud", refused="answers no probe"))
    status = agent.status()
    return replace(status, decision=replace(status.decision, options=options, challenger=(options[0], 45.0)))


@pytest.fixture
def serve(agent):
    """Serves a status as the agent would; gives the port."""
    with ExitStack() as servers:

        def serve(status):
            server = StatusServer(
                0,
                lambda: document("walker", "guide", status, 60.0),
                lambda: metrics("walker", "guide", status, agent.report()),
            )
            servers.callback(server.close)
            return server.port

        yield serve


@pytest.fixture
def port(serve, status):
    return serve(status)


def test_the_document_says_everything_in_plain_numbers(status):
    found = document("walker", "guide", status, 60.0)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert (found["source"], found["why"]) == ("fallback", "no command has come yet")
    assert found["instance"] == {"id": "i1", "state": "running", "site": "edge", "reason": ""}
    assert found["task"]["options"][1] == {"name": "cloud", "cost": None, "parts": {}, "refused": "answers no probe"}
    assert found["task"]["challenger"] == {"name": "edge", "for_s": 15.0}
    assert found["link"]["paths"][0]["mtu"] == 1400
    assert found["transitions"] == [{"ago_s": 10.0, "source": "fallback", "reason": "start"}]
    assert "secret" not in json.dumps(found)


def test_topics_stand_beside_what_became_of_their_messages(status, serve):
    scan = TopicStats("scan", "in", 5, refused=3, offered=10, sent=8, delivered=5, superseded=1, lost=1)
    seen = (
        Followed("scan", "/scan", "sensor_msgs/msg/LaserScan", "from", ("/laser",), True, "best effort"),
        Followed("map", "/map", "nav_msgs/msg/OccupancyGrid", "from"),
        Followed("goal", "/goal", "x", "to", refused="another type hash", passed=12, dropped=3),
    )
    status = replace(status, session=SessionStats(True, (scan,)), topics=seen, rates={("scan", "in"): 39.96})
    (first, *rest) = document("walker", "guide", status, 60.0)["topics"]
    counts = first["messages"]
    assert counts["published"] == counts["refused"] + counts["dropped"] + counts["sent"] == 13
    assert counts["sent"] == sum(counts[n] for n in ("delivered", "superseded", "lost", "unsettled"))
    assert (first["hz"], first["graph"]["nodes"], first["graph"]["quality"]) == (40.0, ["/laser"], "best effort")
    assert [(t["topic"], t["messages"]) for t in rest] == [("map", None), ("goal", None)]
    assert [(t["graph"]["passed"], t["graph"]["dropped"]) for t in rest] == [(None, 0), (12, 3)]
    shown = CliRunner().invoke(app, ["robot", "status", "--port", str(serve(status))], env={"COLUMNS": "200"})
    assert "/scan from /laser (best effort)" in shown.output
    assert "/map: nobody publishes it yet" in shown.output
    assert "not carried: another type hash" in shown.output
    assert "published = refused + dropped + sent" in shown.output


def test_the_diagnostics_tell_control_service_and_session_apart(status):
    found = diagnostics("walker", "guide", "/walker/skytether", status, 60.5)
    assert found["header"]["stamp"] == {"sec": 60, "nanosec": 500_000_000}
    assert [(s["name"], s["level"], s["message"]) for s in found["status"]] == [
        ("walker/skytether: control", Level.WARN, "driven by fallback: no command has come yet"),
        ("walker/skytether: service", Level.OK, "running"),
        ("walker/skytether: session", Level.WARN, "not connected"),
    ]
    values = {value["key"]: value["value"] for value in found["status"][1]["values"]}
    assert values == {"asked for": "guide", "instance": "i1", "site": "edge"}
    asking = diagnostics("walker", "guide", "/s", replace(status, instance=None), 0.0)["status"][1]
    assert (asking["level"], asking["message"]) == (Level.WARN, "no instance")


def test_metrics_are_those_of_the_report_and_the_robots_own(status, agent):
    text = metrics("walker", "guide", status, agent.report()).decode()
    for line in (
        'skytether_control_source{robot="walker",service="guide",source="fallback"} 1.0',
        'skytether_fallback_transitions_total{reason="start",robot="walker",service="guide"} 1.0',
        'skytether_task_cost{option="edge",robot="walker",service="guide"} 0.4',
        'skytether_task_cost{option="cloud",robot="walker",service="guide"} +Inf',
        'skytether_session_connected{robot="walker",service="guide"} 0.0',
        'skytether_control_overruns_total{robot="walker"} 0.0',
    ):
        assert line in text
    assert (
        'skytether_topic_one_way_delay_seconds{direction="out",priority="127",quantile="0.5",robot="walker",'
        'service="guide",topic="cmd_vel"} 0.02'
    ) in text


def test_both_are_served_on_loopback_and_nothing_else_is(port):
    url = f"http://127.0.0.1:{port}"
    assert httpx.get(f"{url}/status").json()["robot"] == "walker"
    assert httpx.get(f"{url}/metrics?x=1").headers["content-type"].startswith("text/plain")
    assert httpx.get(f"{url}/token").status_code == 404
    assert httpx.post(f"{url}/status").status_code == 501


def test_the_command_prints_tables_or_json(port):
    result = CliRunner().invoke(app, ["robot", "status", "--port", str(port), "--json"])
    assert json.loads(result.stdout)["service"] == "guide"
    result = CliRunner().invoke(app, ["robot", "status", "--port", str(port)])
    assert result.exit_code == 0


def test_what_a_service_said_last_is_shown_as_it_is_and_obeyed_by_nobody(status, serve):
    said = 'its last line: "[/x] [red]\x1b]0;title\x07"'
    status = replace(status, instance=status.instance.model_copy(update={"reason": said}))
    result = CliRunner().invoke(app, ["robot", "status", "--port", str(serve(status))])
    assert result.exit_code == 0
    assert "[/x] [red]\\x1b]0;title\\x07" in result.output
    assert "\x1b]" not in result.output


def test_a_web_page_whose_name_was_made_this_address_reads_nothing():
    server = StatusServer(0, lambda: {"battery": 1.0}, lambda: b"")
    url = f"http://127.0.0.1:{server.port}"
    for path in ("/status", "/metrics", "/"):
        assert httpx.get(url + path, headers={"Host": f"evil.example:{server.port}"}).status_code == 421
    for host in ("localhost", f"localhost:{server.port}", "[::1]", "192.0.2.7:80"):
        assert httpx.get(f"{url}/status", headers={"Host": host}).status_code == 200
    server.close()


@pytest.mark.slow
def test_who_asks_without_end_holds_up_neither_the_others_nor_the_end(capfd):
    server, ended = StatusServer(0, dict, lambda: b""), threading.Event()

    def drip():
        with socket.create_connection(("127.0.0.1", server.port)) as link, suppress(OSError):
            link.sendall(b"GET /status HTTP/1.1\r\nA: ")
            while not ended.wait(0.1):
                link.sendall(b"b")

    threads = [threading.Thread(target=drip) for _ in range(8)]
    for thread in threads:
        thread.start()
    try:
        assert httpx.get(f"http://127.0.0.1:{server.port}/status", timeout=30).status_code == 200
        for thread in threads:
            thread.join(30)
        assert not any(thread.is_alive() for thread in threads), "each is ended when its time is over"
        again = threading.Thread(target=drip)
        again.start()
        threads.append(again)
        server.close()
        assert not [thread for thread in threading.enumerate() if thread.name == "status"]
    finally:
        ended.set()
        for thread in threads:
            thread.join()
    assert "Traceback" not in capfd.readouterr().err


def test_more_connections_than_there_is_room_for_are_closed():
    server = StatusServer(0, dict, lambda: b"", patience_s=60.0)  # it is not this that ends them
    links = [socket.create_connection(("127.0.0.1", server.port), timeout=10) for _ in range(16)]
    for _ in range(24):
        with socket.create_connection(("127.0.0.1", server.port), timeout=10) as beyond:
            assert beyond.recv(1) == b""
    for link in links:
        link.close()
    server.close()


def test_a_status_that_cannot_be_told_harms_nobody():
    server = StatusServer(0, lambda: {"x": 1 / 0}, lambda: b"")
    assert httpx.get(f"http://127.0.0.1:{server.port}/status").status_code == 500
    result = CliRunner().invoke(app, ["robot", "status", "--port", str(server.port)])
    assert result.exit_code == 1
    server.close()
    assert CliRunner().invoke(app, ["robot", "status", "--port", str(server.port)]).exit_code == 1


def test_an_agent_whose_port_is_taken_answers_on_the_next_and_is_found_by_its_robot_s_name(
    port, base, orchestrator, caplog
):
    with Agent(replace(CONFIG, robot="second", status_port=port), base, client=orchestrator) as second:
        found_at = second.status_port
        assert found_at in range(port + 1, port + 16)
        for name in ("walker", "second"):
            found = CliRunner().invoke(app, ["robot", "status", name, "--port", str(port), "--json"])
            assert json.loads(found.stdout)["robot"] == name
        nobody = CliRunner().invoke(app, ["robot", "status", "third", "--port", str(port)])
        assert nobody.exit_code == 1
        assert "no agent of robot third answers" in " ".join(nobody.output.split())
    assert second.status_port is None
    assert f"the status of robot second is on port {found_at}" in caplog.text


def test_no_free_port_keeps_no_robot_from_driving(base, orchestrator, caplog):
    last = 65_535  # above it there is none to be tried
    first = StatusServer(last, dict, lambda: b"")
    with Agent(replace(CONFIG, status_port=last), base, client=orchestrator) as agent:
        assert agent.status_port is None
    first.close()
    assert base.written
    assert "no status on port 65535 of loopback" in caplog.text


def test_in_a_pipe_no_row_is_broken_and_a_site_called_local_is_listed_once(status, serve):
    options = (Option("local", {"delay": 0.3}), Option(None, refused="the fallback only stops, " * 6))
    port = serve(replace(status, decision=replace(status.decision, options=options)))
    result = CliRunner().invoke(app, ["robot", "status", "--port", str(port)])
    first = [line.split("│")[1].strip() for line in result.stdout.splitlines() if line.count("│") == 4]
    assert first.count("local") == 1
    assert "own controller" in first
    assert "the fallback only stops, " * 5 in result.stdout
