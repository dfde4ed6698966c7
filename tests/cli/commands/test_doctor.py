"""Each failure that the doctor knows, staged for real."""

import contextlib
import http.server
import json
import socket
import ssl
import subprocess
import threading
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from typer.testing import CliRunner

from skytether.bridge.echo import EchoServer
from skytether.cli.app import app
from skytether.lab.netns import Namespace
from skytether.robot.diagnosis import examine

ROBOT, SITE = "10.0.7.2", "10.0.7.1"


def doctor(*arguments):
    """Findings by check, and the exit status."""
    result = CliRunner().invoke(app, ["doctor", "--json", *map(str, arguments)])
    assert result.stdout, result.output
    return {finding["check"]: finding for finding in json.loads(result.stdout)}, result.exit_code


class Orchestrator(http.server.BaseHTTPRequestHandler):
    """Answers like one whose clock is off."""

    off = timedelta()

    def do_GET(self):
        self.send_response(200 if self.path == "/healthz" else 404)
        self.end_headers()

    def date_time_string(self, timestamp=None):
        return format_datetime(datetime.now(UTC) + self.off, usegmt=True)

    def log_message(self, *_):
        pass


@contextlib.contextmanager
def serving(off=timedelta(), context=None):
    server = http.server.HTTPServer(("127.0.0.1", 0), type("Handler", (Orchestrator,), {"off": off}))
    if context is not None:
        server.socket = context.wrap_socket(server.socket, server_side=True)
    thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    try:
        yield server.server_address[1]
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.fixture
def echo():
    with EchoServer("127.0.0.1", 0) as server:
        yield f"127.0.0.1:{server.address[1]}"


def test_a_good_site_has_no_trouble(echo):
    with serving() as port:
        found, status = doctor("--url", f"http://127.0.0.1:{port}", "--echo", echo)
    assert {check: finding["state"] for check, finding in found.items()} == dict.fromkeys(
        ("extras", "orchestrator", "clock", "udp", "mtu", "nat"), "ok"
    )
    assert status == 0


def test_a_wrong_clock_is_found(echo):
    with serving(timedelta(hours=-1)) as port:
        found, status = doctor("--url", f"http://127.0.0.1:{port}", "--echo", echo)
    assert "ahead of the orchestrator's" in found["clock"]["says"]
    assert status == 1


def test_an_orchestrator_that_is_not_there_is_found(echo):
    with serving() as port:
        pass
    found, status = doctor("--url", f"http://127.0.0.1:{port}", "--echo", echo)
    assert found["orchestrator"]["state"] == "trouble"
    assert "skytether orchestrator run" in found["orchestrator"]["todo"]
    assert status == 1


@pytest.fixture
def certificate(tmp_path):
    """A self-signed one for 127.0.0.1; its file."""
    import ipaddress

    key, now = ec.generate_private_key(ec.SECP256R1()), datetime.now(UTC)
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "orchestrator")])
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]), False)
        .sign(key, hashes.SHA256())
    )
    path = tmp_path / "orchestrator.pem"
    path.write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
        + made.public_bytes(serialization.Encoding.PEM)
    )
    return path


@pytest.mark.slow
def test_a_self_signed_certificate_is_found_and_trusted_when_given(certificate, echo):
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate)
    with serving(context=context) as port:
        url = f"https://127.0.0.1:{port}"
        found, status = doctor("--url", url, "--echo", echo)
        assert "--ca-file" in found["certificate"]["todo"]
        assert status == 1
        found, status = doctor("--url", url, "--echo", echo, "--ca-file", certificate)
        assert found["certificate"]["state"] == "ok"
        assert status == 0
        found, _ = doctor("--url", f"https://localhost:{port}", "--echo", echo, "--ca-file", certificate)
        assert "another name" in found["certificate"]["says"]


@pytest.mark.slow
def test_a_site_without_an_echo_is_udp_trouble():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.1", 0))
        found, status = doctor("--echo", f"127.0.0.1:{silent.getsockname()[1]}")
    assert "nothing comes back" in found["udp"]["says"]
    assert found["mtu"]["state"] == found["nat"]["state"] == "skipped"
    assert status == 1


def test_wrong_usage_is_told():
    assert CliRunner().invoke(app, ["doctor"]).exit_code == 2
    assert CliRunner().invoke(app, ["doctor", "--echo", "nowhere"]).exit_code == 2
    assert CliRunner().invoke(app, ["doctor", "/no/such/robot.yaml"]).exit_code == 2


ROBOT_YAML = """
robot: walker
orchestrator: http://127.0.0.1:{port}
token_file: token
service: virtual-trail
fallback: stop
ros1: {{master: "http://127.0.0.1:{master}"}}
"""


def test_a_dead_ros_master_and_a_missing_token_are_found(tmp_path, echo):
    with serving() as dead:
        pass
    robot = tmp_path / "robot.yaml"
    with serving() as port:
        robot.write_text(ROBOT_YAML.format(port=port, master=dead))
        found, status = doctor(robot, "--echo", echo)
    assert "nobody answers" in found["ros master"]["says"]
    assert "start roscore" in found["ros master"]["todo"]
    assert "cannot read token_file" in found["token"]["says"]
    assert found["fallback"]["state"] == "ok"
    assert status == 1


# The network's failures, in namespaces of their own.


class Cable:
    """A robot and a site, one cable."""

    def __init__(self, robot, site):
        self.robot, self.site = robot, site
        site.ip("link", "add", "eth0", "type", "veth", "peer", "name", "eth0", "netns", robot.path)
        for end, address in ((robot, ROBOT), (site, SITE)):
            end.ip("address", "add", f"{address}/24", "dev", "eth0")
            end.ip("link", "set", "eth0", "up")

    def rules(self, where, text):
        where.run(lambda: subprocess.run(["nft", "-f", "-"], input=text, text=True, check=True))

    def look(self, port):
        return {f.check: f for f in self.robot.run(lambda: list(examine.network(SITE, port)))}


@pytest.fixture
def cable(nftables):
    with Namespace() as robot, Namespace() as site:
        yield Cable(robot, site)


@pytest.fixture
def echo_port(cable):
    server = cable.site.run(lambda: EchoServer(SITE, 0))
    yield server.address[1]
    server.close()


DROP = """table ip f {{
    chain i {{
        type filter hook input priority 0; policy accept;
        {}
    }}
}}"""


@pytest.mark.slow
def test_a_firewall_that_drops_udp_is_found(cable, echo_port):
    assert cable.look(echo_port)["udp"].state == "ok"
    cable.rules(cable.site, DROP.format("meta l4proto udp drop"))
    found = cable.look(echo_port)
    assert found["udp"].state == "trouble"
    assert "firewall" in found["udp"].todo


@pytest.mark.slow
def test_a_small_mtu_is_found_known_or_silent(cable, echo_port):
    for end in (cable.robot, cable.site):
        end.ip("link", "set", "eth0", "mtu", "1000")
    found = cable.look(echo_port)["mtu"]
    assert (found.state, "datagrams of 972 bytes" in found.says) == ("trouble", True)
    for end in (cable.robot, cable.site):
        end.ip("link", "set", "eth0", "mtu", "1500")
    cable.rules(cable.site, DROP.format("meta length > 900 drop"))
    found = cable.look(echo_port)["mtu"]
    assert (found.state, "datagrams of 872 bytes" in found.says) == ("trouble", True)


@pytest.mark.slow
def test_a_router_that_rebinds_is_found(cable, echo_port):
    assert cable.look(echo_port)["nat"].state == "ok"
    ended = threading.Event()

    def rebind():
        first = 20_000
        while not ended.wait(0.1):
            first = 20_000 + (first + 1_000) % 20_000
            cable.rules(
                cable.robot,
                f"""flush ruleset
                table ip nat {{
                    chain post {{
                        type nat hook postrouting priority srcnat; policy accept;
                        meta l4proto udp masquerade to :{first}-{first + 999};
                    }}
                }}""",
            )
            cable.robot.run(lambda: subprocess.run(["conntrack", "-F"], check=True, capture_output=True))

    thread = threading.Thread(target=rebind)
    thread.start()
    try:
        for _ in range(10):  # whether a rebind falls between two of ten datagrams is chance
            found = cable.look(echo_port)["nat"]
            if found.state == "trouble":
                break
    finally:
        ended.set()
        thread.join()
    assert "addresses in turn" in found.says
    assert "paths in robot.yaml" in found.todo
